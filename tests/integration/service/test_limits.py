"""Large and slow uploads: refused early, and never held in memory."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from google.rpc import status_pb2
from redis import Redis
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_jobs import keys
from refine_proto.convert import to_message
from refine_proto.errors import UploadTimeout
from refine_proto.models import RefinementSpec
from refine_proto.status import STATUS_KEY, from_status
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub

MIB = 2**20
CHUNK = b"#" * (64 * 1024)
HEAD = b'--b\r\nContent-Disposition: form-data; name="mesh"; filename="m.obj"\r\n\r\n'
MULTIPART = {"Content-Type": "multipart/form-data; boundary=b"}
HEADER = pb.CreateRefinementRequest.Header(
    spec=to_message(
        RefinementSpec.model_validate({"camera": CAMERA, "mesh_format": "obj"}), pb.RefinementSpec
    )
)


@pytest.fixture(scope="module")
def shared_service(redis_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    settings = {
        "max_mesh_bytes": MIB,
        "max_silhouette_bytes": 1000,
        "max_json_bytes": 2000,
        "upload_timeout_s": 1,
    }
    with run_service(redis_url, tmp_path_factory.mktemp("service"), settings) as service:
        yield service


class Body:
    """An endless upload that counts what it was asked for."""

    def __init__(self) -> None:
        self.sent = 0

    def __iter__(self) -> Iterator[bytes]:
        yield HEAD
        while self.sent < 400 * MIB:
            self.sent += len(CHUNK)
            yield CHUNK


def test_an_endless_body_is_cut_off(service: Service) -> None:
    """By hand on a socket: what a server that does not read does to an HTTP library is another matter."""
    address = service.rest_url.removeprefix("http://").split(":")
    sent = 0
    with socket.create_connection((address[0], int(address[1])), timeout=30) as connection:
        connection.sendall(
            b"POST /v1/refinements HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n"
            b"Content-Type: multipart/form-data; boundary=b\r\n\r\n" + b"%x\r\n%s\r\n" % (len(HEAD), HEAD)
        )
        try:
            while sent < 400 * MIB:
                connection.sendall(b"%x\r\n%s\r\n" % (len(CHUNK), CHUNK))
                sent += len(CHUNK)
        except OSError:
            pass  # the server has closed its side
        answer = connection.recv(65536)
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert b'"reason":"PAYLOAD_TOO_LARGE"' in answer
    assert sent < 40 * MIB


def test_an_announced_size_is_refused_unread(rest: httpx.Client) -> None:
    body = Body()
    headers = {**MULTIPART, "Content-Length": str(300 * MIB)}
    answer = rest.post("/v1/refinements", content=iter(body), headers=headers)
    assert (answer.status_code, answer.json()["reason"]) == (413, "PAYLOAD_TOO_LARGE")
    assert answer.headers["Connection"] == "close"
    assert body.sent < 40 * MIB


@pytest.mark.parametrize(("part", "size"), [("mesh", MIB + 1), ("silhouette", 1001)])
def test_each_file_has_its_limit(rest: httpx.Client, part: str, size: int) -> None:
    files: dict[str, Any] = {"mesh": ("m.obj", MESH), "silhouette": ("s.png", PNG)}
    files[part] = (files[part][0], files[part][1].ljust(size, b"#"))
    answer = rest.post("/v1/refinements", files=files, data={"camera": json.dumps(CAMERA)})
    assert (answer.status_code, answer.json()["errors"][0]["pointer"]) == (413, f"/{part}")


def test_json_bodies_have_theirs(rest: httpx.Client) -> None:
    answer = rest.post("/v1/refinements", json={"mesh": "A" * 3000})
    assert answer.status_code == 413
    assert "multipart/form-data" in answer.json()["detail"]


def test_grpc_stops_reading(service: Service) -> None:
    asked = 0

    def messages() -> Iterator[pb.CreateRefinementRequest]:
        nonlocal asked
        yield pb.CreateRefinementRequest(header=HEADER)
        while asked < 400 * MIB:
            asked += len(CHUNK)
            yield pb.CreateRefinementRequest(mesh_chunk=CHUNK)

    with grpc.insecure_channel(service.grpc_address) as channel, pytest.raises(grpc.RpcError) as caught:
        RefinementsStub(channel).CreateRefinement(messages())
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert asked < 40 * MIB


@pytest.mark.parametrize(
    ("messages", "code"),
    [
        ([], "INVALID_ARGUMENT"),
        ([pb.CreateRefinementRequest(mesh_chunk=b"v")], "INVALID_ARGUMENT"),
        ([pb.CreateRefinementRequest(header=HEADER)] * 2, "INVALID_ARGUMENT"),
        ([pb.CreateRefinementRequest(header=pb.CreateRefinementRequest.Header())], "INVALID_ARGUMENT"),
        (
            [pb.CreateRefinementRequest(header=pb.CreateRefinementRequest.Header(mesh_bytes=2 * MIB))],
            "RESOURCE_EXHAUSTED",
        ),
    ],
)
def test_bad_streams(service: Service, messages: list[pb.CreateRefinementRequest], code: str) -> None:
    with grpc.insecure_channel(service.grpc_address) as channel, pytest.raises(grpc.RpcError) as caught:
        RefinementsStub(channel).CreateRefinement(iter(messages))
    assert caught.value.code().name == code


def test_an_upload_that_stalls_is_ended(service: Service, redis: Redis) -> None:
    address = service.rest_url.removeprefix("http://").split(":")
    with socket.create_connection((address[0], int(address[1])), timeout=30) as connection:
        connection.sendall(
            b"POST /v1/refinements HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n"
            b"Content-Type: multipart/form-data; boundary=b\r\n\r\n" + HEAD
        )
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 504 ")
    assert b'"reason":"UPLOAD_TIMEOUT"' in answer
    assert not redis.exists(keys.UPLOADS)


def test_a_stream_that_stalls_is_ended(service: Service) -> None:
    answered = threading.Event()

    def messages() -> Iterator[pb.CreateRefinementRequest]:
        yield pb.CreateRefinementRequest(header=HEADER)
        answered.wait(30)

    with grpc.insecure_channel(service.grpc_address) as channel, pytest.raises(grpc.RpcError) as caught:
        RefinementsStub(channel).CreateRefinement(messages())
    answered.set()
    trailers: Any = caught.value.trailing_metadata()
    error = from_status(status_pb2.Status.FromString(dict(trailers)[STATUS_KEY]))
    assert caught.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    assert type(error) is UploadTimeout


def test_a_deadline_of_the_caller_ends_a_watch(service: Service) -> None:
    with service.client("rest") as client:
        refinement_id = client.submit(MESH, PNG, CAMERA, mesh_format="obj").id
    request = pb.WatchRefinementRequest(id=refinement_id)
    with grpc.insecure_channel(service.grpc_address) as channel, pytest.raises(grpc.RpcError) as caught:
        list(RefinementsStub(channel).WatchRefinement(request, timeout=1))
    assert caught.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_large_files_pass_through(redis_url: str, redis: Redis, tmp_path: Path, transport: str) -> None:
    """60 MB each way, with less than 20 MB more memory."""
    mesh, size = tmp_path / "coarse.obj", 60 * MIB
    mesh.write_bytes(MESH + b"#" * (size - len(MESH)))
    with run_service(redis_url, tmp_path / "data") as service:
        with service.client(transport) as client:
            hand = Hand(redis, service.data_folder)
            small = client.submit(MESH, PNG, CAMERA, mesh_format="obj")
            hand.run(small.id, {"refined.glb": MESH})
            client.download(small.id, tmp_path / "small")
            before = service.peak_memory_bytes()

            refinement = client.submit(mesh, PNG, CAMERA)
            uploaded = service.peak_memory_bytes()
            job = hand.run(refinement.id, {"refined.glb": mesh.read_bytes()})
            assert job.mesh.size_bytes == size
            files = client.download(refinement.id, tmp_path / "large")
            downloaded = service.peak_memory_bytes()
        assert files["refined.glb"].stat().st_size == size
        assert uploaded - before < 20e6
        assert downloaded - before < 20e6
