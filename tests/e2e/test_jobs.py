"""What else a caller does with jobs, and what the server says to one who errs."""

from __future__ import annotations

import httpx
import pytest
import torch
from sample import CAMERA, MESH, OPTIONS, SILHOUETTE, form

from refine_client import RefineClient
from refine_engine import read_mesh
from refine_proto.errors import NotFound
from refine_proto.models import EventType, Refinement, State

POINTS = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def refine_sample(client: RefineClient) -> Refinement:
    """The shortest whole job."""
    sent = client.submit(MESH, SILHOUETTE, CAMERA, {**OPTIONS, "iterations": 1})
    ended = client.wait(sent.id, timeout_s=300)
    assert ended.state is State.SUCCEEDED, ended.error
    return ended


def test_one_call_gives_the_mesh(rest: httpx.Client) -> None:
    headers = {"Prefer": "wait=60", "Accept": "model/gltf-binary"}
    answer = rest.post("/refinements", headers=headers, **form())
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "model/gltf-binary"), answer.text
    refined = read_mesh(answer.content, "refined.glb").mesh
    assert torch.equal(refined.faces, read_mesh(MESH.read_bytes(), MESH.name).mesh.faces)
    record = rest.get(answer.headers["Location"].removeprefix("/v1")).json()
    assert answer.headers["ETag"].strip('"') in {file["sha256"] for file in record["artifacts"]}


def test_cancel_stops_a_running_job(client: RefineClient) -> None:
    sent = client.submit(MESH, SILHOUETTE, CAMERA, {**OPTIONS, "iterations": 2000})
    for event in client.watch(sent.id, timeout_s=300):
        if event.type is EventType.PROGRESS:
            break
    assert client.cancel(sent.id).state is State.CANCELLING
    ended = client.wait(sent.id, timeout_s=60)
    assert ended.state is State.CANCELLED
    assert ended.artifacts == []
    assert ended.progress is not None
    assert ended.progress.iteration < 2000
    refine_sample(client)


@pytest.mark.parametrize("case", ["points only", "truncated GLB"])
def test_a_bad_mesh_fails_its_job_alone(case: str, client: RefineClient, rest: httpx.Client) -> None:
    mesh = POINTS
    if case == "truncated GLB":
        good = refine_sample(client)
        whole = rest.get(f"/refinements/{good.id}/artifacts/refined.glb").content
        mesh = whole[: len(whole) // 2]
    sent = client.submit(mesh, SILHOUETTE, CAMERA, OPTIONS, mesh_format="glb" if mesh != POINTS else "obj")
    failed = client.wait(sent.id, timeout_s=300)
    assert failed.state is State.FAILED
    assert failed.error is not None
    assert (failed.error.reason, failed.error.retryable) == ("MESH_INVALID", False)
    assert ("triangle" if mesh == POINTS else "truncated") in failed.error.detail
    refine_sample(client)


def test_an_unknown_option_is_told_the_nearest(rest: httpx.Client) -> None:
    answer = rest.post("/refinements", **form(iteration=3))
    assert (answer.status_code, answer.headers["Content-Type"]) == (422, "application/problem+json")
    problem = answer.json()
    assert problem["reason"] == "OPTIONS_INVALID"
    [error] = problem["errors"]
    assert error["pointer"] == "/options/iteration"
    assert "did you mean 'iterations'?" in error["detail"]


def test_the_same_key_gives_the_same_job(rest: httpx.Client) -> None:
    headers = {"Idempotency-Key": "e2e-once", "Prefer": "wait=60"}
    first, again = (rest.post("/refinements", headers=headers, **form(iterations=1)) for _ in range(2))
    assert [first.status_code, again.status_code] == [200, 200]
    assert "Idempotency-Replayed" not in first.headers
    assert again.headers["Idempotency-Replayed"] == "true"
    assert again.json() == first.json()
    other = rest.post("/refinements", headers=headers, **form(iterations=2))
    assert (other.status_code, other.json()["reason"]) == (422, "IDEMPOTENCY_KEY_REUSED")


def test_a_deleted_job_is_not_found(client: RefineClient, rest: httpx.Client) -> None:
    ended = refine_sample(client)
    assert rest.delete(f"/refinements/{ended.id}").status_code == 204
    for path in (f"/refinements/{ended.id}", f"/refinements/{ended.id}/artifacts/refined.glb"):
        answer = rest.get(path)
        assert (answer.status_code, answer.json()["reason"]) == (404, "NOT_FOUND")
    with pytest.raises(NotFound):
        client.get(ended.id)
