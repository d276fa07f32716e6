"""The bytes of a request -> what `refine` takes, with every check that is possible before it starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from refine_proto.cameras import CameraSpec
from refine_proto.formats import SILHOUETTE_THRESHOLD

from .cameras.in_view import check_in_view
from .cameras.spec import camera_from_spec
from .files.beside import Beside
from .files.limits import MeshLimits
from .files.mesh_file import MeshFile, read_mesh
from .files.png import read_silhouette
from .method.config import RefineConfig
from .method.loop import refine
from .values import Progress, Result, View


@dataclass(frozen=True)
class Inputs:
    """One request, read and checked."""

    mesh_file: MeshFile
    views: tuple[View, ...]  # at least one
    warnings: tuple[str, ...]  # about the mesh, the silhouettes and the cameras

    def refine(
        self,
        config: RefineConfig,
        device: torch.device | str = "cpu",
        report: Callable[[Progress], None] | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> Result:
        """`refine` on `device`; the result lies there and carries these warnings before its own."""
        mesh, views = self.mesh_file.mesh.to(device), [view.to(device) for view in self.views]
        if self.mesh_file.textured and config.topology == "auto":
            config = replace(config, topology="fixed")  # a hole would show in the texture
        result = refine(mesh, views, config, report, cancelled)
        return replace(result, warnings=(*self.warnings, *result.warnings))


def read_inputs(
    mesh: bytes,
    mesh_name: str,
    silhouette: bytes,
    camera: CameraSpec,
    silhouette_threshold: float = SILHOUETTE_THRESHOLD,
    limits: MeshLimits = MeshLimits(),
    beside: Beside | None = None,
) -> Inputs:
    """Read a mesh file and a silhouette image, for a camera as `read_camera` gives it.

    `mesh_name` matters for its suffix where the bytes do not tell the format; `beside` gives
    the files that the mesh refers to. Raises an InputError: the mesh,
    the silhouette or the camera is invalid, or the camera does not see the mesh.
    """
    mesh_file = read_mesh(mesh, mesh_name, limits, beside)
    view = read_view(silhouette, camera, silhouette_threshold)
    doubt = check_in_view(mesh_file.mesh, view, camera)
    return Inputs(mesh_file, (view,), (*mesh_file.warnings, *([doubt] if doubt else [])))


def read_view(silhouette: bytes, camera: CameraSpec, threshold: float = SILHOUETTE_THRESHOLD) -> View:
    """A silhouette image and the camera that saw it; raises SilhouetteInvalid or CameraInvalid."""
    coverage = read_silhouette(silhouette, threshold)
    height, width = coverage.shape
    return View(coverage, camera_from_spec(camera, width, height))
