"""The engine process by itself: what it does when memory is short, and when it cannot start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_proto.models import LookAtCamera, MeshFormat, RefinementSpec
from refine_worker.messages import Failed, Run, StageStarted
from refine_worker.plan import SlotPlan
from refine_worker.settings import WorkerSettings
from refine_worker.slot.engine_process import EngineProcess, EngineStartFailed

PLAN = SlotPlan(name="slot", device="cpu", threads=1)
SPEC = RefinementSpec(
    camera=LookAtCamera(azimuth_degrees=62, elevation_degrees=20, distance=1.6), mesh_format=MeshFormat.OBJ
)


def test_a_mesh_that_needs_too_much_memory_fails(tmp_path: Path) -> None:
    blobs = BlobStore(str(tmp_path))
    corners = np.random.default_rng(0).normal(size=(200_000, 3))
    vertices = "".join(f"v {x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in corners)
    faces = "".join(f"f {i} {i + 1} {i + 2}\n" for i in range(1, len(corners) - 2))
    blobs.put(keys.input_blob("job", keys.MESH), (vertices + faces).encode())
    blobs.put(keys.input_blob("job", keys.SILHOUETTE), b"")
    engine = EngineProcess(PLAN, WorkerSettings(read_memory_bytes=2**20), str(tmp_path))
    try:
        engine.prepare()
        engine.run(Run(job_id="job", attempt=1, spec=SPEC))
        message = engine.receive(60)
        assert isinstance(message, StageStarted)
        message = engine.receive(60)
        assert isinstance(message, Failed)
        assert (message.reason, message.replace_engine) == ("OUT_OF_MEMORY", True)
        assert "fewer vertices" in message.detail
    finally:
        engine.stop()


def test_an_engine_that_cannot_start_says_so(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    engine = EngineProcess(PLAN, WorkerSettings(), str(file / "blobs"))
    with pytest.raises(EngineStartFailed, match="before it was ready"):
        engine.prepare()


def test_an_engine_that_takes_too_long_to_start_is_killed(tmp_path: Path) -> None:
    engine = EngineProcess(PLAN, WorkerSettings(start_timeout_s=0.01), str(tmp_path))
    with pytest.raises(EngineStartFailed, match=r"within 0\.01 s"):
        engine.prepare()
