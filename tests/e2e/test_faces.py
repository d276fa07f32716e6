"""The same request over REST and gRPC, with the sync and the async client: the same job, the same bytes."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from sample import CAMERA, MESH, OPTIONS, SILHOUETTE
from serve_process import Served

from refine_client import AsyncRefineClient, RefineClient
from refine_engine import read_camera, read_inputs, read_mesh
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.contract import estimate_of
from refine_proto.models import (
    CameraEstimate,
    EstimatedCamera,
    Event,
    EventType,
    Refinement,
    State,
    Validation,
)

FACES = ("REST, sync", "REST, async", "gRPC, sync", "gRPC, async")
ARTIFACTS = {
    "refined.glb",
    "confidence.glb",
    "confidence.png",
    "confidence.npz",
    "preview.png",
    "report.json",
}


@dataclass(frozen=True)
class Outcome:
    """What a caller got: the events, the record in its end, and the downloaded files by name."""

    events: list[Event]
    refinement: Refinement
    files: Mapping[str, Path]


def run(server: str, folder: Path) -> Outcome:
    with RefineClient(server) as client:
        sent = client.submit(MESH, SILHOUETTE, CAMERA, OPTIONS)
        events = list(client.watch(sent.id, timeout_s=300))
        ended = client.wait(sent.id, timeout_s=300)
        return Outcome(events, ended, client.download(sent.id, folder))


async def run_async(server: str, folder: Path) -> Outcome:
    async with AsyncRefineClient(server) as client:
        sent = await client.submit(MESH, SILHOUETTE, CAMERA, OPTIONS)
        events = [event async for event in client.watch(sent.id, timeout_s=300)]
        ended = await client.wait(sent.id, timeout_s=300)
        return Outcome(events, ended, await client.download(sent.id, folder))


@pytest.fixture(scope="module")
def outcomes(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Outcome]:
    """One job by each face."""
    folders = {face: tmp_path_factory.mktemp("face") for face in FACES}
    grpc = f"grpc://{served.grpc_address}"
    return {
        "REST, sync": run(served.url, folders["REST, sync"]),
        "REST, async": asyncio.run(run_async(served.url, folders["REST, async"])),
        "gRPC, sync": run(grpc, folders["gRPC, sync"]),
        "gRPC, async": asyncio.run(run_async(grpc, folders["gRPC, async"])),
    }


def test_every_face_says_what_looks_wrong(served: Served) -> None:
    """As the engine does here; the camera that is offered instead is the right one."""
    mirrored = CAMERA | {"azimuth_degrees": -CAMERA["azimuth_degrees"]}
    wrong = (MESH, SILHOUETTE, mirrored)
    inputs = read_inputs(MESH.read_bytes(), MESH.name, SILHOUETTE.read_bytes(), read_camera(mirrored))
    expected = Validation.of(
        silhouette_iou(inputs.mesh_file.mesh, inputs.views[0]), inputs.warnings, inputs.findings
    )
    assert [finding.code for finding in expected.checks] == ["CAMERA_MISREAD"]
    for server in (served.url, f"grpc://{served.grpc_address}"):
        with RefineClient(server) as client:
            validation = client.validate(*wrong)
            assert validation == expected
            assert not client.validate(*wrong, {"checks": "strict"}).accepted
            reading = validation.checks[0].reading
            assert reading is not None
            assert client.validate(MESH, SILHOUETTE, reading.camera).checks == []

        async def ask(server: str = server) -> Validation:
            async with AsyncRefineClient(server) as client:
                return await client.validate(*wrong)

        assert asyncio.run(ask()) == expected


def test_every_face_estimates_the_camera_and_refines_with_it(served: Served) -> None:
    """As the engine does here."""
    inputs = read_inputs(MESH.read_bytes(), MESH.name, SILHOUETTE.read_bytes(), EstimatedCamera())
    expected = estimate_of(inputs.estimate)
    for server in (served.url, f"grpc://{served.grpc_address}"):
        with RefineClient(server) as client:
            assert client.estimate_camera(MESH, SILHOUETTE) == expected
            job = client.submit(MESH, SILHOUETTE, {"type": "estimate"}, {"iterations": 2})
            assert client.wait(job.id).camera == expected

        async def ask(server: str = server) -> CameraEstimate:
            async with AsyncRefineClient(server) as client:
                return await client.estimate_camera(MESH, SILHOUETTE)

        assert asyncio.run(ask()) == expected


def settled(refinement: Refinement) -> dict[str, Any]:
    """The record without ids, times, addresses, and the report, in which there are times."""
    times = {"created_at", "started_at", "finished_at", "expires_at"}
    record = refinement.model_dump(exclude={"id", "urls", "progress", "artifacts", *times})
    files = [file.model_dump(exclude={"url"}) for file in refinement.artifacts if file.name != "report.json"]
    return record | {"artifacts": files}


def report(outcome: Outcome) -> dict[str, Any]:
    """report.json without its measured time."""
    content: dict[str, Any] = json.loads(outcome.files["report.json"].read_text())
    assert content.pop("seconds") > 0
    return content


@pytest.mark.parametrize("face", FACES)
def test_the_events_of_a_job(face: str, outcomes: Mapping[str, Outcome]) -> None:
    events = outcomes[face].events
    sequences = [event.sequence for event in events]
    assert sequences == list(range(1, len(events) + 1))
    assert (events[0].type, events[0].state) == (EventType.STATE, State.QUEUED)
    progress = [event.progress for event in events if event.type is EventType.PROGRESS and event.progress]
    assert progress
    iterations = [each.iteration for each in progress]
    assert iterations == sorted(iterations)
    assert progress[-1].total == progress[-1].iteration
    assert all(each.silhouette_iou > 0 for each in progress)
    assert all(each.losses["total"] > 0 for each in progress if each.iteration)
    assert [event.type for event in events].index(EventType.COMPLETED) == len(events) - 1
    assert events[-1].refinement == outcomes[face].refinement


@pytest.mark.parametrize("face", FACES)
def test_the_record_and_the_bytes_are_the_same(face: str, outcomes: Mapping[str, Outcome]) -> None:
    outcome, first = outcomes[face], outcomes[FACES[0]]
    refinement = outcome.refinement
    assert refinement.state is State.SUCCEEDED
    assert refinement.options.model_dump(include=set(OPTIONS)) == OPTIONS
    assert settled(refinement) == settled(first.refinement)
    assert set(outcome.files) == {file.name for file in refinement.artifacts} == ARTIFACTS
    for file in refinement.artifacts:
        content = outcome.files[file.name].read_bytes()
        assert (len(content), hashlib.sha256(content).hexdigest()) == (file.size_bytes, file.sha256)
        if file.name != "report.json":
            assert content == first.files[file.name].read_bytes(), file.name
    assert report(outcome) == report(first)


def test_the_refined_mesh_is_a_better_one(outcomes: Mapping[str, Outcome]) -> None:
    outcome = outcomes[FACES[0]]
    inputs = read_inputs(MESH.read_bytes(), MESH.name, SILHOUETTE.read_bytes(), read_camera(CAMERA))
    coarse = inputs.mesh_file.mesh
    refined = read_mesh(outcome.files["refined.glb"].read_bytes(), "refined.glb").mesh
    assert torch.equal(refined.faces, coarse.faces)
    before, after = (silhouette_iou(mesh, inputs.views[0]) for mesh in (coarse, refined))
    assert after > before + 0.02
    told = outcome.refinement.silhouette_iou
    assert told is not None
    assert (told.before, told.after) == pytest.approx((before, after), abs=1e-3)
