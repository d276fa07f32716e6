"""Validations: a worker slot, played by hand, answers while the call waits; nothing of them is kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_client import RefineClient
from refine_jobs import keys
from refine_jobs.record import Job
from refine_proto.checks import Code, Finding, Severity
from refine_proto.errors import MeshInvalid, Unavailable
from refine_proto.models import Validation

FINDING = Finding(code=Code.NO_OVERLAP, severity=Severity.REFUSED, message="expected more")
ANSWER = Validation.of(0.25, ["expected more"], [FINDING])


def assert_nothing_is_left(hand: Hand, jobs: list[Job]) -> None:
    (job,) = jobs
    assert not hand.redis.exists(keys.JOB + job.id)
    assert job.id in hand.store.trash()


def test_the_answer_comes_with_the_call(client: RefineClient, hand: Hand) -> None:
    """Before refinements that wait longer, and out of their list."""
    waiting = client.submit(MESH, PNG, CAMERA, mesh_format="obj").id
    listed: list[list[str]] = []

    def answer(job: Job) -> None:
        listed.append([item.id for item in client.list().refinements])
        hand.store.answer(job, ANSWER)

    with hand.answering(answer) as taken:
        validation = client.validate(MESH, PNG, CAMERA, {"checks": "strict"}, mesh_format="obj")
    assert validation == ANSWER
    assert not validation.accepted
    assert taken[0].spec["options"]["checks"] == "strict"
    assert listed == [[waiting]]
    assert_nothing_is_left(hand, taken)


def test_what_cannot_be_read_is_an_error_of_the_call(client: RefineClient, hand: Hand) -> None:
    with (
        hand.answering(lambda job: hand.store.fail(job, MeshInvalid("expected triangles"))) as taken,
        pytest.raises(MeshInvalid, match="expected triangles"),
    ):
        client.validate(MESH, PNG, CAMERA, mesh_format="obj")
    assert_nothing_is_left(hand, taken)


def test_a_worker_of_an_older_version_does_not_answer(client: RefineClient, hand: Hand) -> None:
    """It refines."""
    with hand.answering(lambda job: hand.finish(job, {})) as taken, pytest.raises(Unavailable):
        client.validate(MESH, PNG, CAMERA, mesh_format="obj")
    assert_nothing_is_left(hand, taken)


def test_rest_takes_multipart_and_says_what_is_wrong_with_it(rest: httpx.Client, hand: Hand) -> None:
    files: dict[str, Any] = {
        "mesh": ("coarse.obj", MESH),
        "silhouette": ("s.png", PNG),
        "camera": (None, json.dumps(CAMERA)),
    }
    with hand.answering(lambda job: hand.store.answer(job, ANSWER)):
        answer = rest.post("/v1/refinements:validate", files=files)
    assert answer.status_code == 200
    assert Validation.model_validate_json(answer.content) == ANSWER
    bad = rest.post("/v1/refinements:validate", files=files | {"camera": (None, "{}")})
    assert (bad.status_code, bad.json()["reason"]) == (422, "CAMERA_INVALID")


def test_a_call_that_nobody_answers_ends_and_leaves_nothing(
    redis_url: str, redis: Redis, tmp_path: Path
) -> None:
    with run_service(redis_url, tmp_path, {"answer_timeout_s": "0.3"}) as service:
        _nobody_answers(service, Hand(redis, tmp_path))


def _nobody_answers(service: Service, hand: Hand) -> None:
    for transport in ("rest", "grpc"):
        with service.client(transport) as client, pytest.raises(Unavailable, match="ask again") as caught:
            client.validate(MESH, PNG, CAMERA, mesh_format="obj")
        assert caught.value.retry_after_s == 5
        assert hand.redis.zcard(keys.QUEUED) == 0
        assert not hand.redis.keys(keys.JOB + "*")
