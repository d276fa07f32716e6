"""Webhooks of a real service, at a real HTTP server that answers, fails, redirects, is slow or is not there.

The Redis is this file's own: another service on the same one would deliver as well.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from threading import Event

import pytest
from service_process import Hand, Service, run_service
from webhook_receiver import Receiver, deliveries, make_due, receive, submit, until

from refine_client import RefineClient, verify_webhook
from refine_jobs import keys
from refine_jobs.embedded import EmbeddedRedis
from refine_proto.errors import OutOfMemory
from refine_service.edge.auth import ANONYMOUS, ApiKeys

SETTINGS = {"reachable_networks": "127.0.0.1"}
FILES = {"refined.glb": b"glTF"}


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server.url


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("webhooks")


@pytest.fixture(scope="module")
def secret(folder: Path) -> str:
    return ApiKeys(folder / "keys.json").add_webhook_secret(ANONYMOUS, timedelta())


@pytest.fixture(scope="module")
def shared_service(redis_url: str, folder: Path, secret: str) -> Iterator[Service]:
    with run_service(redis_url, folder, SETTINGS) as service:
        yield service


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receive() as found:
        yield found


def test_the_end_is_told(client: RefineClient, hand: Hand, receiver: Receiver, secret: str) -> None:
    refinement = submit(client, receiver.url)
    hand.run(refinement.id, FILES)
    [request] = receiver.wait(1)
    message = verify_webhook(request.body, request.headers, secret)
    assert message.type == "refinement.succeeded"
    assert request.headers["webhook-id"] == refinement.id
    [delivery] = deliveries(client, refinement.id, 1)
    ended = client.get(refinement.id)
    assert message.data == ended.model_copy(update={"webhook_deliveries": []})
    assert message.timestamp == ended.finished_at
    assert (delivery.attempt, delivery.status, delivery.error) == (1, 204, None)
    assert hand.redis.zcard(keys.OUTBOX) == 0
    assert not hand.redis.exists(keys.WEBHOOK + refinement.id)


def test_only_the_ends_that_were_asked_for(client: RefineClient, hand: Hand, receiver: Receiver) -> None:
    refinement = submit(client, receiver.url, events=["failed", "cancelled"])
    hand.run(refinement.id, FILES)
    assert hand.redis.zcard(keys.OUTBOX) == 0
    failed = submit(client, receiver.url, events=["failed"])
    hand.store.fail(hand.start(failed.id), OutOfMemory("expected less, got more"))
    cancelled = submit(client, receiver.url, events=["cancelled"])
    client.cancel(cancelled.id)
    told = {(r.headers["webhook-id"], b"refinement.failed" in r.body) for r in receiver.wait(2)}
    assert told == {(failed.id, True), (cancelled.id, False)}


def test_a_receiver_that_fails_is_tried_again_with_the_same_message(
    client: RefineClient, hand: Hand, secret: str
) -> None:
    with receive(Receiver(statuses=(500, 429, 200))) as receiver:
        refinement = submit(client, receiver.url)
        hand.run(refinement.id, FILES)
        for attempt in (1, 2):
            last = deliveries(client, refinement.id, attempt)[-1]
            assert last.next_attempt_at is not None
            make_due(hand.redis, refinement.id)
        requests = receiver.wait(3)
    assert len({request.body for request in requests}) == 1
    assert {request.headers["webhook-id"] for request in requests} == {refinement.id}
    for request in requests:
        verify_webhook(request.body, request.headers, secret)
    found = deliveries(client, refinement.id, 3)
    assert [d.status for d in found] == [500, 429, 200]
    assert [d.error is None for d in found] == [False, False, True]


def test_a_receiver_that_says_gone_is_left_alone(client: RefineClient, hand: Hand) -> None:
    with receive(Receiver(statuses=(410,))) as receiver:
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        [delivery] = deliveries(client, refinement.id, 1)
    assert (delivery.status, delivery.next_attempt_at) == (410, None)
    assert hand.redis.zcard(keys.OUTBOX) == 0


def test_a_redirect_is_not_followed(client: RefineClient) -> None:
    with receive(Receiver(statuses=(307,))) as receiver:
        receiver.headers = {"Location": receiver.url + "/elsewhere"}
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        [delivery] = deliveries(client, refinement.id, 1)
        assert delivery.status == 307
        assert "redirect" in str(delivery.error)
        assert len(receiver.got) == 1


def test_a_dead_receiver_that_comes_back_gets_it(client: RefineClient, hand: Hand) -> None:
    with receive() as receiver:
        pass  # it had this port
    refinement = submit(client, receiver.url)
    client.cancel(refinement.id)
    [delivery] = deliveries(client, refinement.id, 1)
    assert (delivery.status, delivery.error) == (None, "expected an answer, got none (ConnectError)")
    with receive(receiver):
        make_due(hand.redis, refinement.id)
        receiver.wait(1)


def test_after_the_last_attempt_there_is_no_other(client: RefineClient, hand: Hand) -> None:
    with receive(Receiver(statuses=(503,))) as receiver:
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        deliveries(client, refinement.id, 1)
        hand.redis.hset(keys.WEBHOOK + refinement.id, "attempt", 9)
        make_due(hand.redis, refinement.id)
        last = deliveries(client, refinement.id, 2)[-1]
    assert (last.attempt, last.next_attempt_at) == (10, None)
    assert hand.redis.zcard(keys.OUTBOX) == 0


def test_a_slow_receiver_holds_up_nobody(client: RefineClient, receiver: Receiver) -> None:
    with receive(Receiver(hold=Event())) as slow:
        waits = submit(client, slow.url)
        client.cancel(waits.id)
        slow.wait(1)
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        deliveries(client, refinement.id, 1)
        assert client.get(waits.id).webhook_deliveries == []


def test_two_services_deliver_each_once(
    service: Service, hand: Hand, redis_url: str, folder: Path, receiver: Receiver
) -> None:
    with service.client("rest") as client, run_service(redis_url, folder, SETTINGS):
        ids = [submit(client, receiver.url).id for _ in range(20)]
        for refinement_id in ids:
            client.cancel(refinement_id)
        until(lambda: hand.redis.zcard(keys.OUTBOX), lambda left: left == 0)
    assert sorted(request.headers["webhook-id"] for request in receiver.got) == sorted(ids)


def test_a_deleted_refinement_tells_nobody(client: RefineClient, hand: Hand) -> None:
    with receive(Receiver(statuses=(503,))) as receiver:
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        deliveries(client, refinement.id, 1)
        client.delete(refinement.id)
    assert hand.redis.zcard(keys.OUTBOX) == 0
    assert not hand.redis.exists(keys.WEBHOOK + refinement.id)


def test_an_expired_refinement_still_tells_what_it_told_before(client: RefineClient, hand: Hand) -> None:
    with receive(Receiver(statuses=(503, 200))) as receiver:
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        deliveries(client, refinement.id, 1)
        hand.expire(refinement.id)
        make_due(hand.redis, refinement.id)
        first, second = receiver.wait(2)
        until(lambda: hand.redis.zcard(keys.OUTBOX), lambda left: left == 0)
    assert first.body == second.body
    assert hand.redis.hget(keys.JOB + refinement.id, "state") == "expired"


def test_an_error_of_the_server_is_an_attempt_like_any_other(client: RefineClient, hand: Hand) -> None:
    with receive(Receiver(statuses=(503, 200))) as receiver:
        refinement = submit(client, receiver.url)
        client.cancel(refinement.id)
        deliveries(client, refinement.id, 1)
        record = keys.JOB + refinement.id
        hand.redis.hset(record, "checks", "{}")  # which cannot be read
        hand.redis.hdel(keys.WEBHOOK + refinement.id, "body")
        make_due(hand.redis, refinement.id)
        until(
            lambda: json.loads(str(hand.redis.hget(record, "webhook_deliveries"))), lambda all: len(all) == 2
        )
        hand.redis.hset(record, "checks", "[]")
        last = deliveries(client, refinement.id, 2)[-1]
        assert "an error of the server" in str(last.error)
        assert last.next_attempt_at is not None
        make_due(hand.redis, refinement.id)
        receiver.wait(2)


def test_secrets_change_over(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    file = ApiKeys(path)
    _, key = file.add("ann")
    first = file.add_webhook_secret("ann", timedelta(hours=1))
    second = file.add_webhook_secret("ann", timedelta(hours=1))
    file.add_webhook_secret("ben", timedelta())
    assert ApiKeys(path).webhook_secrets("ann") == [second, first]
    third = file.add_webhook_secret("ann", timedelta())
    assert ApiKeys(path).webhook_secrets("ann") == [third]
    found = ApiKeys(path).find(key)
    assert found is not None
    assert found.owner == "ann"
