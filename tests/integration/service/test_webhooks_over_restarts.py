"""Webhooks where services come and go. The Redis is this file's own: no other service delivers from it."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from threading import Event

import pytest
from redis import Redis
from service_process import Hand, run_service
from webhook_receiver import Receiver, deliveries, make_due, receive, submit

from refine_client import verify_webhook
from refine_jobs import keys
from refine_jobs.embedded import EmbeddedRedis
from refine_proto.errors import InvalidInput
from refine_proto.models import State
from refine_service.edge.auth import ANONYMOUS, ApiKeys

SETTINGS = {"reachable_networks": "127.0.0.1"}
FILES = {"refined.glb": b"glTF"}


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server.url


@pytest.mark.parametrize(
    "url",
    ["http://localhost:1/", "http://169.254.169.254/latest/meta-data", "https://[::1]/", "http://10.0.0.1"],
)
def test_private_addresses_are_not_reached(redis: Redis, redis_url: str, tmp_path: Path, url: str) -> None:
    """Of a service that allows none; what the caller reads tells nothing of the network."""
    ApiKeys(tmp_path / "keys.json").add_webhook_secret(ANONYMOUS, timedelta())
    with run_service(redis_url, tmp_path) as service, service.client("rest") as client:
        refinement = submit(client, url)
        client.cancel(refinement.id)
        [delivery] = deliveries(client, refinement.id, 1)
    assert "expected a public address" in str(delivery.error)
    assert delivery.status is None


def test_a_webhook_outlives_the_services(redis: Redis, redis_url: str, tmp_path: Path) -> None:
    """It ends while no service runs; the next one is killed amid its attempt; a third delivers."""
    secret = ApiKeys(tmp_path / "keys.json").add_webhook_secret(ANONYMOUS, timedelta())
    hand = Hand(redis, tmp_path)
    hold = Event()
    with receive(Receiver(hold=hold)) as receiver:
        with run_service(redis_url, tmp_path, SETTINGS) as service, service.client("rest") as client:
            refinement = submit(client, receiver.url)
        job = hand.start(refinement.id)
        hand.finish(job, FILES)
        assert redis.zscore(keys.OUTBOX, refinement.id) is not None
        with run_service(redis_url, tmp_path, SETTINGS) as service:
            receiver.wait(1)
            service.process.kill()
        hold.set()
        make_due(redis, refinement.id)  # its lease is over
        with run_service(redis_url, tmp_path, SETTINGS) as service, service.client("grpc") as client:
            first, second = receiver.wait(2)
            [delivery] = deliveries(client, refinement.id, 1)
        assert (delivery.attempt, delivery.status) == (2, 204)
        for request in (first, second):
            assert verify_webhook(request.body, request.headers, secret).data.state is State.SUCCEEDED


def test_who_has_no_secret_is_told_so(redis: Redis, redis_url: str, tmp_path: Path) -> None:
    with run_service(redis_url, tmp_path) as bare, bare.client("rest") as client:
        with pytest.raises(InvalidInput, match="refine keys webhook-secret anonymous") as caught:
            submit(client, "https://example.com/hook")
        assert caught.value.errors[0].pointer == "/webhook"
        with bare.client("grpc") as client, pytest.raises(InvalidInput, match="expected an address"):
            submit(client, "example.com")
