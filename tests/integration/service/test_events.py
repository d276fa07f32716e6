"""Following a refinement: server-sent events and gRPC watches, with the same sequence numbers."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from redis import Redis
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_client import RefineClient
from refine_proto.convert import to_model
from refine_proto.errors import Draining, Unavailable
from refine_proto.models import Event, EventType, State
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub


def submit(service: Service) -> str:
    with service.client("rest") as client:
        return client.submit(MESH, PNG, CAMERA, mesh_format="obj").id


def sse(
    rest: httpx.Client, refinement_id: str, headers: dict[str, str] | None = None
) -> list[dict[str, str]]:
    """All events of a stream that ends, as fields."""
    answer = rest.get(f"/v1/refinements/{refinement_id}/events", headers=headers)
    assert answer.status_code == 200
    assert answer.headers["Content-Type"].startswith("text/event-stream")
    assert answer.headers["Cache-Control"] == "no-cache"
    blocks = [block for block in answer.text.split("\n\n") if block and not block.startswith(":")]
    return [dict(line.split(": ", 1) for line in block.splitlines()) for block in blocks]


def test_both_transports_tell_the_same_events(service: Service, rest: httpx.Client, hand: Hand) -> None:
    refinement_id = submit(service)
    job = hand.start(refinement_id)
    hand.report(job, 5)
    hand.finish(job, {"refined.glb": b"glTF"})
    told = sse(rest, refinement_id)
    assert [(e["event"], e["id"]) for e in told] == [
        ("state", "1"),
        ("state", "2"),
        ("progress", "3"),
        ("completed", "4"),
    ]
    events = [Event.model_validate_json(e["data"]) for e in told]
    with grpc.insecure_channel(service.grpc_address) as channel:
        request = pb.WatchRefinementRequest(id=refinement_id)
        watched = [to_model(m, Event) for m in RefinementsStub(channel).WatchRefinement(request)]
    assert watched == events
    assert events[-1].refinement
    assert (
        events[-1].refinement.model_dump(mode="json") == rest.get(f"/v1/refinements/{refinement_id}").json()
    )


def test_replay(service: Service, rest: httpx.Client, hand: Hand) -> None:
    refinement_id = submit(service)
    hand.run(refinement_id, {})
    assert [e["id"] for e in sse(rest, refinement_id, {"Last-Event-ID": "1"})] == ["2", "3"]
    assert sse(rest, refinement_id, {"Last-Event-ID": "3"}) == []
    with grpc.insecure_channel(service.grpc_address) as channel:
        request = pb.WatchRefinementRequest(id=refinement_id, after_sequence=1)
        assert [m.sequence for m in RefinementsStub(channel).WatchRefinement(request)] == [2, 3]


@pytest.mark.parametrize("last", ["-1", "x", str(2**63)])
def test_no_sequence(service: Service, rest: httpx.Client, last: str) -> None:
    path = f"/v1/refinements/{submit(service)}/events"
    answer = rest.get(path, headers={"Last-Event-ID": last})
    assert (answer.status_code, answer.json()["reason"]) == (422, "INPUT_INVALID")


def test_events_arrive_while_they_happen(client: RefineClient, service: Service, hand: Hand) -> None:
    refinement_id = submit(service)
    seen: list[Event] = []
    started = threading.Event()

    def watch() -> None:
        for event in client.watch(refinement_id):
            seen.append(event)
            started.set()

    watcher = threading.Thread(target=watch)
    watcher.start()
    assert started.wait(30)
    job = hand.start(refinement_id)
    for iteration in (2, 4):
        hand.report(job, iteration)
    hand.finish(job, {})
    watcher.join(30)
    assert [event.sequence for event in seen] == [1, 2, 3, 4, 5]
    assert [event.progress.iteration for event in seen if event.progress] == [2, 4]
    assert seen[-1].refinement
    assert seen[-1].refinement.state is State.SUCCEEDED


def in_thread(act: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    results: list[Any] = []

    def run() -> None:
        try:
            results.append(act())
        except Exception as error:
            results.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, results


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_drain_ends_streams_and_waits(redis_url: str, redis: Redis, tmp_path: Path) -> None:
    with run_service(redis_url, tmp_path) as service, service.rest() as rest, ExitStack() as stack:
        refinement_id = submit(service)
        follower = stack.enter_context(service.client("grpc"))
        watch, watched = in_thread(lambda: list(follower.watch(refinement_id)))
        stream, streamed = in_thread(lambda: rest.get(f"/v1/refinements/{refinement_id}/events"))
        camera = json.dumps(CAMERA)
        files = {"mesh": ("m.obj", MESH), "silhouette": ("s.png", PNG)}
        fields = {"camera": camera}
        wait, waited = in_thread(
            lambda: rest.post("/v1/refinements", files=files, data=fields, headers={"Prefer": "wait=60"})
        )
        until(lambda: 'refine_watchers{transport="rest"} 1.0' in rest.get("/metrics").text)
        until(lambda: 'refine_watchers{transport="grpc"} 1.0' in rest.get("/metrics").text)
        until(lambda: "refine_queued_jobs 2.0" in rest.get("/metrics/installation").text)
        assert service.stop() == 0
        for thread in (watch, stream, wait):
            thread.join(30)
            assert not thread.is_alive()
    [ended], [refused], [answer] = streamed, watched, waited
    assert "shutting down" in ended.text
    assert "retry: 2000" in ended.text
    assert isinstance(refused, Draining | Unavailable)
    assert (answer.status_code, answer.json()["state"]) == (202, "queued")


def test_a_dropped_watch_is_forgotten(service: Service, rest: httpx.Client, hand: Hand) -> None:
    refinement_id = submit(service)
    with rest.stream("GET", f"/v1/refinements/{refinement_id}/events") as stream:
        lines = stream.iter_lines()
        assert next(lines) == "event: state"
        assert 'refine_watchers{transport="rest"} 1.0' in rest.get("/metrics").text
    until(lambda: 'refine_watchers{transport="rest"} 0.0' in rest.get("/metrics").text)
    hand.run(refinement_id, {})  # dropping a watch cancels nothing


def test_the_last_event_carries_the_record(client: RefineClient, service: Service, hand: Hand) -> None:
    refinement_id = submit(service)
    hand.run(refinement_id, {"refined.glb": b"glTF"})
    last = list(client.watch(refinement_id))[-1]
    assert last.type is EventType.COMPLETED
    assert last.refinement == client.get(refinement_id)
