"""Requests made to cost the service time: what they cost is counted in fields and bytes, never in seconds."""

from __future__ import annotations

import json
from collections.abc import Iterator

import httpx
import pytest
from service_process import CAMERA, MESH, PNG, Service, run_service

from refine_proto.strict import MAX_COMPLAINTS

BASE64 = {"mesh": "AA==", "silhouette": "AA=="}
ANSWER_BYTES = 32 * 1024


@pytest.fixture(scope="module")
def service(redis_server: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with run_service(redis_server, tmp_path_factory.mktemp("service")) as service:
        yield service


def options(count: int) -> dict[str, int]:
    """That do not exist."""
    return {f"option_{number:x}": 1 for number in range(count)}


def post(service: Service, body: object) -> httpx.Response:
    with service.rest() as rest:
        return rest.post("/v1/refinements", json=body)


def test_unknown_fields_are_told_up_to_a_number(service: Service) -> None:
    answer = post(service, {"camera": CAMERA, "options": options(9000), **BASE64})
    assert (answer.status_code, answer.json()["reason"]) == (422, "OPTIONS_INVALID")
    assert len(answer.json()["errors"]) == MAX_COMPLAINTS
    assert len(answer.content) < ANSWER_BYTES


def test_wrong_items_are_told_up_to_a_number(service: Service) -> None:
    """Beside the names of fields: items of a list, of which the last complaint tells the number."""
    answer = post(service, {"camera": CAMERA, "views": [{"camera": 1}] * 4000, **BASE64})
    assert answer.status_code == 422
    assert len(answer.json()["errors"]) <= MAX_COMPLAINTS
    assert len(answer.content) < ANSWER_BYTES


def test_json_of_very_many_values_is_refused_unparsed(service: Service) -> None:
    answer = post(service, {"camera": CAMERA, "options": options(100_000), **BASE64})
    assert (answer.status_code, answer.json()["reason"]) == (413, "PAYLOAD_TOO_LARGE")


def test_a_name_without_end_is_not_repeated(service: Service) -> None:
    answer = post(service, {"camera": CAMERA, "options": {"a" * 10_000_000: 1}, **BASE64})
    assert answer.status_code == 422
    assert len(answer.content) < ANSWER_BYTES


def test_a_multipart_field_is_bounded_alike(service: Service) -> None:
    fields = {"camera": json.dumps(CAMERA), "options": json.dumps(options(3000))}
    files = {"mesh": ("m.obj", MESH), "silhouette": ("s.png", PNG)}
    with service.rest() as rest:
        answer = rest.post("/v1/refinements", data=fields, files=files)
    assert (answer.status_code, len(answer.json()["errors"])) == (422, MAX_COMPLAINTS)
    assert len(answer.content) < ANSWER_BYTES


def test_a_large_json_body_waits_on_disk(service: Service) -> None:
    """Ten of the largest, one after the other on one connection each, leave no trace in the memory."""
    body = json.dumps({"camera": CAMERA, "mesh": "A" * (15 * 2**20), "silhouette": "AA=="}).encode()
    headers = {"Content-Type": "application/json"}
    with service.rest() as rest:
        assert rest.get("/livez").status_code == 200
        before = service.peak_memory_bytes()
        for _ in range(5):
            assert rest.post("/v1/refinements", content=body, headers=headers).status_code == 415
    assert service.peak_memory_bytes() - before < 6 * len(body)
