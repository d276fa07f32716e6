"""The engine process by itself: what it does when memory is short, and when it cannot start."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_worker.messages import Failed, Phase, PhaseStarted, Run
from refine_worker.plan import SlotPlan
from refine_worker.reports import Report
from refine_worker.settings import ReadLimits, WorkerSettings
from refine_worker.slot.engine_process import EngineProcess, EngineStartFailed

LIMITS = ReadLimits(base_cpu_s=60, base_wall_s=60, memory_bytes=2**32)
PLAN = SlotPlan(name="slot", device="cpu", threads=1, read_limits=LIMITS)
REPORTS: list[Report] = []  # to a supervisor; nobody reads them
SAMPLE = Path(__file__).parents[3] / "examples" / "samples" / "chair"
CAMERA = {"type": "look_at", "azimuth_degrees": 62, "elevation_degrees": 20, "distance": 1.6}


def test_a_mesh_that_needs_too_much_memory_fails(tmp_path: Path) -> None:
    blobs = BlobStore(str(tmp_path))
    corners = np.random.default_rng(0).normal(size=(200_000, 3))
    vertices = "".join(f"v {x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in corners)
    faces = "".join(f"f {i} {i + 1} {i + 2}\n" for i in range(1, len(corners) - 2))
    blobs.put(keys.input_blob("job", keys.MESH), (vertices + faces).encode())
    blobs.put(keys.input_blob("job", keys.SILHOUETTE), b"")
    plan = PLAN.model_copy(update={"read_limits": LIMITS.model_copy(update={"memory_bytes": 2**20})})
    engine = EngineProcess(plan, WorkerSettings(), str(tmp_path), REPORTS.append)
    try:
        engine.prepare()
        engine.run(Run(job_id="job", attempt=1, spec={"camera": CAMERA, "mesh_format": "obj"}))
        assert [engine.receive(60), engine.receive(60)] == [
            PhaseStarted(phase=Phase.FETCH), PhaseStarted(phase=Phase.READ)
        ]  # fmt: skip
        message = engine.receive(60)
        assert isinstance(message, Failed)
        assert (message.reason, message.replace_engine) == ("OUT_OF_MEMORY", True)
        assert "fewer vertices" in message.detail
    finally:
        engine.kill()


def test_files_that_take_too_long_cost_their_job_and_not_the_engine(tmp_path: Path) -> None:
    blobs = BlobStore(str(tmp_path))
    image = io.BytesIO()
    Image.new("L", (4096, 4096)).save(image, "PNG")
    blobs.put(keys.input_blob("job", keys.MESH), (SAMPLE / "coarse.obj").read_bytes())
    blobs.put(keys.input_blob("job", keys.SILHOUETTE), image.getvalue())
    plan = PLAN.model_copy(update={"read_limits": LIMITS.model_copy(update={"base_cpu_s": 0.001})})
    engine = EngineProcess(plan, WorkerSettings(), str(tmp_path), REPORTS.append)
    spec = {"camera": json.loads((SAMPLE / "camera.json").read_text()), "mesh_format": "obj"}
    try:
        engine.prepare()
        for attempt in (1, 2):
            engine.run(Run(job_id="job", attempt=attempt, spec=spec))
            *_, message = [engine.receive(60) for _ in range(3)]
            assert isinstance(message, Failed)
            assert (message.reason, message.replace_engine) == ("MESH_INVALID", False)
            assert "simplify the mesh" in message.detail
        assert engine.warm
    finally:
        engine.kill()


def test_an_engine_that_cannot_start_says_so(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    engine = EngineProcess(PLAN, WorkerSettings(), str(file / "blobs"), REPORTS.append)
    with pytest.raises(EngineStartFailed, match="before it was ready"):
        engine.prepare()


def test_an_engine_that_takes_too_long_to_start_is_killed(tmp_path: Path) -> None:
    engine = EngineProcess(PLAN, WorkerSettings(start_timeout_s=0.01), str(tmp_path), REPORTS.append)
    with pytest.raises(EngineStartFailed, match=r"within 0\.01 s"):
        engine.prepare()


def test_a_mesh_that_the_edge_let_in_is_read_whatever_its_size(tmp_path: Path) -> None:
    """An operator may let in more than the default: the limit on bytes is the edge's alone."""
    blobs = BlobStore(str(tmp_path))
    blobs.put(keys.input_blob("job", keys.MESH), padded_glb(257 * 2**20))
    blobs.put(keys.input_blob("job", keys.SILHOUETTE), (SAMPLE / "silhouette.png").read_bytes())
    spec = {"camera": json.loads((SAMPLE / "camera.json").read_text())}
    engine = EngineProcess(PLAN, WorkerSettings(), str(tmp_path), REPORTS.append)
    try:
        engine.prepare()
        engine.run(Run(job_id="job", attempt=1, spec=spec))
        stages = [PhaseStarted(phase=phase) for phase in (Phase.FETCH, Phase.READ, Phase.REFINE)]
        assert [engine.receive(60) for _ in stages] == stages
    finally:
        engine.kill()


def padded_glb(padding: int) -> bytes:
    """A triangle, and so many bytes that belong to nothing."""
    corners = struct.pack("<9f", -0.3, 0, 0, 0.3, 0, 0, 0, 0.4, 0)
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(corners)}],
        "buffers": [{"byteLength": len(corners) + padding}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = [(b"JSON", text), (b"BIN\0", corners + bytes(padding))]
    body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
