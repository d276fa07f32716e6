"""Reading, listing, cancelling and deleting, the same over both transports."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, cast

import grpc
import httpx
import pytest
from judgement import JUDGEMENT
from service_process import CAMERA, MESH, PNG, Hand, Service

from refine_client import RefineClient
from refine_jobs import keys
from refine_proto.convert import to_model
from refine_proto.errors import Conflict, Diverged, Expired, InvalidInput, NotFound, ServerError
from refine_proto.models import Refinement, State
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub


def submit(client: RefineClient) -> Refinement:
    return client.submit(MESH, PNG, CAMERA, mesh_format="obj")


@pytest.mark.parametrize("end", ["queued", "running", "succeeded", "failed", "cancelled"])
def test_both_transports_show_the_same_record(
    service: Service, rest: httpx.Client, hand: Hand, end: str
) -> None:
    with service.client("rest") as client:
        refinement_id = submit(client).id
        if end == "cancelled":
            client.cancel(refinement_id)
    if end in ("running", "succeeded", "failed"):
        job = hand.start(refinement_id)
        hand.report(job, 3)
        if end == "succeeded":
            hand.finish(job, {"refined.glb": b"glTF", "report.json": b"{}"})
        elif end == "failed":
            hand.store.fail(job, Diverged("the loss is not finite"))

    shown = Refinement.model_validate(rest.get(f"/v1/refinements/{refinement_id}").json())
    with grpc.insecure_channel(service.grpc_address) as channel:
        stub = RefinementsStub(channel)
        message = stub.GetRefinement(pb.GetRefinementRequest(id=refinement_id))
        page = stub.ListRefinements(pb.ListRefinementsRequest())
    assert to_model(message, Refinement) == shown
    assert [to_model(item, Refinement) for item in page.refinements] == [shown]
    assert shown.state == end
    assert shown.urls
    assert shown.urls.refinement == f"/v1/refinements/{refinement_id}"
    if end == "succeeded":
        assert {name: getattr(shown, name) for name in type(JUDGEMENT).model_fields} == dict(JUDGEMENT)
        assert shown.artifacts[0].url == f"/v1/refinements/{refinement_id}/artifacts/refined.glb"
    if end == "failed":
        assert shown.error
        assert shown.error.reason == "DIVERGED"


def test_an_error_of_the_server_is_none_of_the_job(client: RefineClient, hand: Hand) -> None:
    refinement_id = submit(client).id
    hand.redis.hset(keys.JOB + refinement_id, "progress", "{}")
    with pytest.raises(ServerError, match="not of the request") as caught:
        client.get(refinement_id)
    assert caught.value.reason == "SERVER_ERROR"
    assert caught.value.request_id


def test_pages(client: RefineClient) -> None:
    sent = [submit(client).id for _ in range(5)]
    first = client.list(limit=2)
    second = client.list(limit=2, cursor=first.next_cursor)
    third = client.list(limit=2, cursor=second.next_cursor)
    pages = [[item.id for item in page.refinements] for page in (first, second, third)]
    assert pages == [sent[:2:-1], sent[2:0:-1], sent[:1]]
    assert third.next_cursor is None


def test_a_list_of_some(client: RefineClient, hand: Hand) -> None:
    marks = [{"set": "chairs", "n": "1"}, {"set": "chairs", "n": "2"}, {"set": "cars = fast", "n": "1"}, {}]
    sent = [client.submit(MESH, PNG, CAMERA, mesh_format="obj", metadata=mark).id for mark in marks]
    client.cancel(sent[1])
    hand.start(sent[2])

    def found(**wanted: Any) -> list[str]:
        return [item.id for item in client.list_all(**wanted)]

    assert client.get(sent[2]).metadata == marks[2]
    assert found() == sent[::-1]
    assert found(metadata={"set": "chairs"}) == [sent[1], sent[0]]
    assert found(metadata={"set": "cars = fast", "n": "1"}) == [sent[2]]
    assert found(metadata={"set": "chairs"}, state="queued") == [sent[0]]
    assert found(state=["running", State.CANCELLED]) == [sent[2], sent[1]]
    assert found(metadata={"set": "lamps"}) == []
    first = client.list(limit=1, metadata={"n": "1"})
    assert [item.id for item in first.refinements] == [sent[2]]
    second = client.list(limit=1, metadata={"n": "1"}, cursor=first.next_cursor)
    assert ([item.id for item in second.refinements], second.next_cursor) == ([sent[0]], None)


def test_wrong_filters(service: Service, rest: httpx.Client) -> None:
    for query, pointer in (
        ("state=done", "/state"),
        ("metadata=chairs", "/metadata"),
        ("metadata=%20=a", "/metadata"),
    ):
        answer = rest.get(f"/v1/refinements?{query}")
        assert answer.status_code == 422
        assert answer.json()["errors"][0]["pointer"].startswith(pointer)
    with grpc.insecure_channel(service.grpc_address) as channel:
        for number in (0, 99):
            state = cast(pb.Refinement.State, number)
            with pytest.raises(grpc.RpcError, match="expected one of queued"):
                RefinementsStub(channel).ListRefinements(pb.ListRefinementsRequest(state=[state]))


def test_a_lifetime(client: RefineClient, hand: Hand) -> None:
    refinement_id = submit(client).id
    with pytest.raises(Conflict, match="queued"):
        client.extend(refinement_id, 60)
    hand.run(refinement_id, {"refined.glb": b"glTF"})
    for lifetime_s in (10 * 86_400, 60):
        extended = client.extend(refinement_id, lifetime_s)
        left_s = (extended.expires_at - datetime.now(UTC)).total_seconds()
        assert lifetime_s - 30 < left_s <= lifetime_s + 1
        assert hand.redis.zscore(keys.EXPIRY, refinement_id) == extended.expires_at.timestamp() * 1000
    for lifetime_s in (0, -1, 31 * 86_400):
        with pytest.raises(InvalidInput) as caught:
            client.extend(refinement_id, lifetime_s)
        assert caught.value.errors[0].pointer == "/lifetime_s"
    with pytest.raises(NotFound):
        client.extend("unknown", 60)
    hand.expire(refinement_id)
    with pytest.raises(Expired):
        client.extend(refinement_id, 60)


def test_bad_pages(client: RefineClient) -> None:
    for limit in (0, 101):
        with pytest.raises(InvalidInput):
            client.list(limit=limit)
    with pytest.raises(InvalidInput) as caught:
        client.list(cursor="nonsense")
    assert caught.value.errors[0].pointer == "/cursor"


def test_cancelling(client: RefineClient, hand: Hand) -> None:
    queued, running = submit(client), submit(client)
    job = hand.start(running.id)
    assert client.cancel(queued.id).state is State.CANCELLED
    assert client.cancel(running.id).state is State.CANCELLING
    assert hand.store.renew(job) is State.CANCELLING  # so the worker hears of it
    hand.store.cancelled(job)
    assert client.cancel(running.id) == client.get(running.id)
    assert client.get(running.id).state is State.CANCELLED


def test_the_status_of_a_cancellation(service: Service, rest: httpx.Client, hand: Hand) -> None:
    with service.client("rest") as client:
        queued, running = submit(client).id, submit(client).id
    hand.start(running)
    assert rest.post(f"/v1/refinements/{queued}/cancel").status_code == 200
    assert rest.post(f"/v1/refinements/{running}/cancel").status_code == 202
    assert rest.post("/v1/refinements/unknown/cancel").status_code == 404


def test_deleting(client: RefineClient, hand: Hand) -> None:
    refinement_id = submit(client).id
    job = hand.start(refinement_id)
    with pytest.raises(Conflict, match="cancel it"):
        client.delete(refinement_id)
    hand.finish(job, {"refined.glb": b"glTF"})
    client.delete(refinement_id)
    with pytest.raises(NotFound):
        client.get(refinement_id)
    assert client.list().refinements == []


def test_the_status_of_a_deletion(service: Service, rest: httpx.Client, hand: Hand) -> None:
    with service.client("rest") as client:
        refinement_id = submit(client).id
    path = f"/v1/refinements/{refinement_id}"
    job = hand.start(refinement_id)
    assert rest.delete(path).status_code == 409
    hand.store.cancelled(job)
    answer = rest.delete(path)
    assert (answer.status_code, answer.content) == (204, b"")
    assert rest.delete(path).status_code == 404


def test_an_expired_record_is_gone(client: RefineClient, hand: Hand) -> None:
    refinement_id = submit(client).id
    hand.run(refinement_id, {"refined.glb": b"glTF"})
    hand.expire(refinement_id)
    for call in (client.get, client.cancel):
        with pytest.raises(Expired, match=refinement_id):
            call(refinement_id)


def test_the_status_of_what_is_gone(service: Service, rest: httpx.Client, hand: Hand) -> None:
    with service.client("rest") as client:
        refinement_id = submit(client).id
    hand.run(refinement_id, {"refined.glb": b"glTF"})
    hand.expire(refinement_id)
    path = f"/v1/refinements/{refinement_id}"
    for gone in (path, f"{path}/events", f"{path}/artifacts/refined.glb"):
        answer = rest.get(gone)
        assert (answer.status_code, answer.json()["reason"]) == (410, "EXPIRED")


def test_what_is_not_there(client: RefineClient) -> None:
    for call in (client.get, client.cancel, client.delete):
        with pytest.raises(NotFound):
            call("0" * 32)
    with pytest.raises(NotFound):
        list(client.watch("0" * 32))


def test_wrong_addresses(rest: httpx.Client) -> None:
    answer = rest.get("/v2/refinements")
    assert (answer.status_code, answer.json()["reason"]) == (404, "NOT_FOUND")
    answer = rest.put("/v1/refinements")
    assert (answer.status_code, answer.json()["reason"]) == (405, "METHOD_NOT_ALLOWED")
    assert answer.headers["Allow"]
