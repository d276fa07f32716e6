"""The bytes of a request -> what `refine` takes, with every check that is possible before it starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch

from refine_proto.cameras import CameraSpec
from refine_proto.checks import Checks, Finding
from refine_proto.formats import SILHOUETTE_THRESHOLD

from .cameras.spec import camera_from_spec
from .checks.check import GivenPlane, check_inputs, refuse
from .files.limits import MeshLimits
from .files.mesh_file import MeshFile, read_mesh
from .files.png import read_silhouette
from .method.config import RefineConfig
from .method.loop import refine
from .values import Progress, Result, View

POOR_IOU = 0.5  # a result that agrees less was hardly meant


@dataclass(frozen=True)
class Inputs:
    """One request, read and checked."""

    mesh_file: MeshFile
    views: tuple[View, ...]  # at least one
    warnings: tuple[str, ...]  # about the mesh, the silhouettes and the cameras
    findings: tuple[Finding, ...] = ()  # those of the warnings that a check of the inputs found

    def refine(
        self,
        config: RefineConfig,
        device: torch.device | str = "cpu",
        report: Callable[[Progress], None] | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> Result:
        """`refine` on `device`; the result lies there and carries these warnings before its own."""
        mesh, views = self.mesh_file.mesh.to(device), [view.to(device) for view in self.views]
        if self.mesh_file.textured:
            config = replace(config, topology="fixed")  # a hole would show in the texture
        result = refine(mesh, views, config, report, cancelled)
        return replace(result, warnings=(*self.warnings, *result.warnings, *_about_the_result(result)))


def read_inputs(
    mesh: bytes,
    mesh_name: str,
    silhouette: bytes,
    camera: CameraSpec,
    silhouette_threshold: float = SILHOUETTE_THRESHOLD,
    limits: MeshLimits = MeshLimits(),
    checks: Checks = Checks.WARN,
    symmetry: GivenPlane | None = None,
) -> Inputs:
    """Read a mesh file and a silhouette image, for a camera as `read_camera` gives it, and check them.

    `mesh_name` matters for its suffix where the bytes do not tell the format; `symmetry` is checked where it
    is given. Raises an InputError: a file or the camera is invalid, or `checks` refuses them together.
    """
    inputs = check_files(mesh, mesh_name, silhouette, camera, silhouette_threshold, limits, checks, symmetry)
    refuse(inputs.findings)
    return inputs


def check_files(
    mesh: bytes,
    mesh_name: str,
    silhouette: bytes,
    camera: CameraSpec,
    silhouette_threshold: float = SILHOUETTE_THRESHOLD,
    limits: MeshLimits = MeshLimits(),
    checks: Checks = Checks.WARN,
    symmetry: GivenPlane | None = None,
) -> Inputs:
    """As `read_inputs`, but what `checks` refuses is told in the findings and not raised."""
    mesh_file = read_mesh(mesh, mesh_name, limits)
    view = read_view(silhouette, camera, silhouette_threshold)
    findings = check_inputs(mesh_file.mesh, view, camera, checks, symmetry) if checks != Checks.OFF else ()
    messages = (finding.message for finding in findings)
    return Inputs(mesh_file, (view,), (*mesh_file.warnings, *messages), findings)


def read_view(silhouette: bytes, camera: CameraSpec, threshold: float = SILHOUETTE_THRESHOLD) -> View:
    """A silhouette image and the camera that saw it; raises SilhouetteInvalid or CameraInvalid."""
    coverage = read_silhouette(silhouette, threshold)
    height, width = coverage.shape
    return View(coverage, camera_from_spec(camera, width, height))


def _about_the_result(result: Result) -> Iterator[str]:
    """What to think of a result that agrees less with the silhouettes than it should."""
    before, after = result.silhouette_iou_before, result.silhouette_iou_after
    advice = "look at it before you use it, and check the camera and the silhouette"
    if after < before:
        yield f"the 2D IoU of the result fell from {before:.3f} to {after:.3f}: {advice}"
    elif after < POOR_IOU:
        yield f"the 2D IoU of the result is only {after:.3f}: {advice}"
