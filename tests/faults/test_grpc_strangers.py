"""gRPC under attack: streams, watchers and connections without end are bounded, and others are answered."""

from __future__ import annotations

import socket
import threading
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from service_process import CAMERA, MESH, PNG, Service, run_service
from worker_process import wait_until

from refine_client import RefineClient
from refine_proto.errors import QuotaExceeded
from refine_proto.models import Event
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub
from refine_service.edge.auth import ApiKeys

MIB = 2**20
SETTINGS = {"require_key": "true", "max_connections": 20, "max_watchers": 4, "max_uploads": 4}
GET = "/refine.v1.Refinements/GetRefinement"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="module")
def key(folder: Path) -> str:
    return ApiKeys(folder / "keys.json").add("ann")[1]


@pytest.fixture(scope="module")
def service(redis_server: str, folder: Path) -> Iterator[Service]:
    with run_service(redis_server, folder, SETTINGS) as service:
        yield service


@pytest.fixture
def channel(service: Service) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(service.grpc_address) as channel:
        yield channel


def codes_of_silent_calls(channel: grpc.Channel, method: str, count: int) -> set[grpc.StatusCode]:
    """How calls end whose message does not come."""
    over = threading.Event()

    def silent() -> Iterator[bytes]:
        over.wait(60)
        yield from ()

    try:
        begin: Any = channel.stream_stream(method)
        return {call.code() for call in [begin(silent()) for _ in range(count)]}
    finally:
        over.set()


def test_a_stranger_is_refused_before_any_message(channel: grpc.Channel) -> None:
    assert codes_of_silent_calls(channel, GET, 50) == {grpc.StatusCode.UNAUTHENTICATED}


def test_a_message_that_does_not_come_is_not_awaited(channel: grpc.Channel) -> None:
    method = "/grpc.health.v1.Health/Check"
    assert codes_of_silent_calls(channel, method, 1) == {grpc.StatusCode.DEADLINE_EXCEEDED}


def test_health_watches_are_bounded(channel: grpc.Channel) -> None:
    stub = health_pb2_grpc.HealthStub(channel)
    watches = [stub.Watch(health_pb2.HealthCheckRequest()) for _ in range(48)]
    for watch in watches:
        next(watch)
    with pytest.raises(grpc.RpcError) as caught:
        next(stub.Watch(health_pb2.HealthCheckRequest()))
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert stub.Check(health_pb2.HealthCheckRequest()).status == health_pb2.HealthCheckResponse.SERVING
    for watch in watches:
        watch.cancel()


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_watchers_are_bounded(service: Service, key: str, transport: str) -> None:
    with service.client(transport, key) as client, ExitStack() as stack:
        refinement = client.submit(MESH, PNG, CAMERA, mesh_format="obj")
        for _ in range(3):
            next(watch := stack.enter_context(service.client(transport, key)).watch(refinement.id))
            stack.callback(cast(Generator[Event, None, None], watch).close)
        with pytest.raises(QuotaExceeded, match="3 watchers"):
            next(client.watch(refinement.id))
    with service.client(transport, key) as client:
        wait_until(lambda: can_watch(client, refinement.id), "the places of the watchers that have gone")
        client.cancel(refinement.id)


def can_watch(client: RefineClient, refinement_id: str) -> bool:
    try:
        next(client.watch(refinement_id))
    except QuotaExceeded:
        return False
    return True


def test_uploads_are_bounded(channel: grpc.Channel, key: str) -> None:
    """Those that have a key and send nothing."""
    metadata = (("authorization", f"Bearer {key}"),)
    create = RefinementsStub(channel).CreateRefinement
    over = threading.Event()

    def silent() -> Iterator[pb.CreateRefinementRequest]:
        over.wait(60)
        yield from ()

    slow = [create.future(silent(), metadata=metadata) for _ in range(3)]

    def is_refused() -> bool:
        with pytest.raises(grpc.RpcError) as caught:
            create(iter(()), metadata=metadata)
        return caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED  # else: without a header

    wait_until(is_refused, "the three calls to have their places")
    for call in slow:
        call.cancel()
    over.set()
    wait_until(lambda: not is_refused(), "their places to be free")


def test_large_metadata_is_refused(channel: grpc.Channel, service: Service) -> None:
    before = service.peak_memory_bytes()
    for _ in range(20):
        with pytest.raises(grpc.RpcError):
            RefinementsStub(channel).ListRefinements(
                pb.ListRefinementsRequest(), metadata=(("x-long", "a" * 200_000),), timeout=20
            )
    assert service.peak_memory_bytes() - before < 20 * MIB


def test_connections_are_bounded(service: Service) -> None:
    """Idle ones, of which each is a descriptor; REST answers beside them."""
    host, _, port = service.grpc_address.rpartition(":")
    with ExitStack() as stack:
        for _ in range(100):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=20))
        wait_until(lambda: 0 < service.open_connections(int(port)) <= 22, "few open connections")
        with service.rest() as rest:
            assert rest.get("/livez").status_code == 200
