"""Cases through a server, over REST or gRPC: what a user gets, and how much of it per minute."""

from __future__ import annotations

import io
import json
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import trimesh
from PIL import Image

from refine_engine.files.mesh_file import read_mesh
from refine_engine.values import Camera, Mesh, MirrorPlane, View

from .cases import Case, Scene, SetInvalid
from .outcome import Outcome


class Refined(Protocol):
    """What is read of a finished refinement: its times, and its artifacts on disk by name."""

    @property
    def refinement(self) -> Any: ...
    @property
    def files(self) -> Mapping[str, Path]: ...


class Client(Protocol):
    """What is used of `refine_client.RefineClient`."""

    def list(self, *, limit: int | None = None) -> Any: ...

    def refine(
        self,
        mesh: bytes,
        silhouette: bytes,
        camera: Mapping[str, Any],
        directory: Path,
        options: Mapping[str, Any],
    ) -> Refined: ...


class ServerMethod:
    """Refines cases through a client that several threads share, and counts."""

    def __init__(self, client: Client, preset: str) -> None:
        self._client, self._preset = client, preset
        self._lock = threading.Lock()
        self._first_start: float | None = None
        self._last_end = 0.0
        self._queue_s: list[float] = []
        self._run_s: list[float] = []

    def __call__(self, case: Case, scene: Scene, seed: int) -> Outcome:
        mesh, silhouette = mesh_bytes(scene.coarse), silhouette_bytes(scene.view)
        options: dict[str, Any] = {"preset": self._preset, "seed": seed}
        if case.plane is not None and case.plane_told:
            options["symmetry_normal"] = list(case.plane.normal)
        with self._lock:
            self._first_start = self._first_start or time.monotonic()
        with tempfile.TemporaryDirectory(prefix="refine-bench-") as folder:
            camera = camera_spec(scene.view.camera)
            refined = self._client.refine(mesh, silhouette, camera, Path(folder), options)
            outcome = _read(refined)
        with self._lock:
            self._last_end = time.monotonic()
            self._queue_s.append(outcome.queue_s or 0.0)
            self._run_s.append(outcome.seconds)
        return outcome

    def summary(self) -> dict[str, float]:
        """Counts of this run: refinements per minute from the first request to the last answer, and times."""
        if not self._run_s or self._first_start is None:
            return {"refinements": 0}
        wall_s = self._last_end - self._first_start
        return {
            "refinements": len(self._run_s),
            "wall_s": round(wall_s, 3),
            "refinements_per_minute": round(60 * len(self._run_s) / wall_s, 3),
            "queue_s_mean": round(statistics.fmean(self._queue_s), 3),
            "queue_s_median": round(statistics.median(self._queue_s), 3),
            "queue_s_max": round(max(self._queue_s), 3),
            "running_s_mean": round(statistics.fmean(self._run_s), 3),
        }


@contextmanager
def server_method(url: str, preset: str, api_key: str | None) -> Iterator[ServerMethod]:
    """Through RefineClient; raises SetInvalid when no server answers at the address."""
    from refine_client import RefineClient

    with ExitStack() as connection:
        try:
            client = connection.enter_context(RefineClient(url, api_key=api_key))
            client.list(limit=1)
        except Exception as error:  # the tree of refine_proto.errors: each says what to do
            raise SetInvalid(f"expected a server that answers at {url}, got: {error}") from error
        yield ServerMethod(client, preset)


def mesh_bytes(mesh: Mesh) -> bytes:
    """Binary PLY: the vertices as they are, none merged."""
    shape = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    data = shape.export(file_type="ply")
    assert isinstance(data, bytes)
    return data


def silhouette_bytes(view: View) -> bytes:
    """PNG, white on black."""
    stream = io.BytesIO()
    levels = (view.silhouette.clamp(0, 1) * 255).round().to(torch.uint8)
    Image.fromarray(levels.numpy()).save(stream, "PNG")
    return stream.getvalue()


def camera_spec(camera: Camera) -> dict[str, Any]:
    """The camera as the contract's `matrix`."""
    return {
        "type": "matrix",
        "convention": "opencv",
        "world_to_camera": camera.world_to_camera.tolist(),
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "projection": camera.projection,
    }


def _read(refined: Refined) -> Outcome:
    files, refinement = refined.files, refined.refinement
    mesh = read_mesh(files["refined.glb"].read_bytes(), "refined.glb").mesh
    with np.load(files["confidence.npz"]) as arrays:
        confidence = torch.from_numpy(arrays["vertex"].astype(np.float32))
    report = json.loads(files["report.json"].read_bytes())
    created, started, finished = refinement.created_at, refinement.started_at, refinement.finished_at
    return Outcome(
        mesh,
        (finished - started).total_seconds(),
        confidence if len(confidence) == len(mesh.vertices) else None,  # per vertex of the mesh that was sent
        _plane(refinement.mirror_plane),
        tuple(report["loss_curve"].get("total", ())),
        (started - created).total_seconds(),
    )


def _plane(plane: Any) -> MirrorPlane | None:
    return plane and MirrorPlane(torch.tensor(plane.normal), plane.offset, plane.error)
