"""Estimates of a camera: a worker slot, played by hand, answers while the call waits."""

from __future__ import annotations

import json
from typing import Any

import httpx
import pytest
from judgement import ESTIMATE
from service_process import CAMERA, MESH, PNG, Hand

from refine_client import RefineClient
from refine_jobs import keys
from refine_jobs.record import Task
from refine_proto.errors import CameraInvalid
from refine_proto.models import CameraEstimate


def test_the_answer_comes_with_the_call_and_nothing_is_left(client: RefineClient, hand: Hand) -> None:
    with hand.answering(lambda job: hand.store.answer(job, ESTIMATE)) as taken:
        found = client.estimate_camera(MESH, PNG, {"elevation_degrees": 20}, mesh_format="obj")
    assert found == ESTIMATE
    (job,) = taken
    assert job.task is Task.ESTIMATE
    assert job.spec["camera"] == {"type": "estimate", "elevation_degrees": 20, "roll_degrees": 0}
    assert not hand.redis.exists(keys.JOB + job.id)
    assert job.id in hand.store.trash()


def test_rest_takes_multipart_and_only_a_camera_that_is_to_be_estimated(
    rest: httpx.Client, hand: Hand
) -> None:
    files: dict[str, Any] = {
        "mesh": ("coarse.obj", MESH),
        "silhouette": ("s.png", PNG),
        "camera": (None, json.dumps({"type": "estimate"})),
    }
    with hand.answering(lambda job: hand.store.answer(job, ESTIMATE)):
        answer = rest.post("/v1/cameras:estimate", files=files)
    assert answer.status_code == 200
    assert CameraEstimate.model_validate_json(answer.content) == ESTIMATE
    refused = rest.post("/v1/cameras:estimate", files=files | {"camera": (None, json.dumps(CAMERA))})
    assert (refused.status_code, refused.json()["reason"]) == (422, "CAMERA_INVALID")
    assert refused.json()["errors"][0]["pointer"] == "/camera"


def test_a_known_camera_is_refused_by_both_transports(client: RefineClient) -> None:
    with pytest.raises(CameraInvalid, match="type estimate, got look_at"):
        client.estimate_camera(MESH, PNG, CAMERA, mesh_format="obj")
