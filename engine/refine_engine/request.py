"""The bytes of a request -> what `refine` takes, with every check that is possible before it starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from refine_proto.cameras import CameraSpec
from refine_proto.checks import Checks, Finding
from refine_proto.formats import SILHOUETTE_THRESHOLD

from .cameras.spec import camera_from_spec
from .checks.check import GivenPlane, check_inputs, refuse
from .errors import InputError
from .files.beside import Beside
from .files.limits import MeshLimits
from .files.mesh_file import MeshFile, read_mesh
from .files.silhouette import read_silhouette
from .method.config import RefineConfig
from .method.loop import Checkpoints
from .proxy.run import refine_any_size
from .values import Progress, Result, View

POOR_IOU = 0.5  # a result that agrees less was hardly meant


@dataclass(frozen=True)
class Observation:
    """The files of one view: an image of the silhouette and the camera that saw it."""

    silhouette: bytes
    camera: CameraSpec
    ignore: bytes | None = None  # an image of the pixels of which nothing is known


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
        checkpoints: Checkpoints | None = None,
    ) -> Result:
        """`refine_any_size` on `device`; the result lies there and carries these warnings before its own."""
        mesh, views = self.mesh_file.mesh.to(device), [view.to(device) for view in self.views]
        if self.mesh_file.textured and config.topology == "auto":
            config = replace(config, topology="fixed")  # a hole would show in the texture
        result = refine_any_size(mesh, views, config, report, cancelled, checkpoints)
        return replace(result, warnings=(*self.warnings, *result.warnings, *_about_the_result(result)))


def read_inputs(
    mesh: bytes,
    mesh_name: str,
    silhouette: bytes,
    camera: CameraSpec,
    silhouette_threshold: float = SILHOUETTE_THRESHOLD,
    limits: MeshLimits = MeshLimits(),
    beside: Beside | None = None,
    *,
    ignore_grey: int | None = None,
    ignore: bytes | None = None,
    more_views: Sequence[Observation] = (),
    checks: Checks = Checks.WARN,
    symmetry: GivenPlane | None = None,
) -> Inputs:
    """Read a mesh file and a silhouette image, for a camera as `read_camera` gives it; and further views.

    `mesh_name` matters for its suffix where the bytes do not tell the format; `beside` gives the files that
    the mesh refers to. See `read_silhouette` for `ignore_grey` and `ignore`. `symmetry` is checked where it
    is given. Raises an InputError: a file or a camera is invalid, or `checks` refuses them together.
    """
    inputs = check_files(
        mesh,
        mesh_name,
        silhouette,
        camera,
        silhouette_threshold,
        limits,
        beside,
        ignore_grey=ignore_grey,
        ignore=ignore,
        more_views=more_views,
        checks=checks,
        symmetry=symmetry,
    )
    refuse(inputs.findings)
    return inputs


def check_files(
    mesh: bytes,
    mesh_name: str,
    silhouette: bytes,
    camera: CameraSpec,
    silhouette_threshold: float = SILHOUETTE_THRESHOLD,
    limits: MeshLimits = MeshLimits(),
    beside: Beside | None = None,
    *,
    ignore_grey: int | None = None,
    ignore: bytes | None = None,
    more_views: Sequence[Observation] = (),
    checks: Checks = Checks.WARN,
    symmetry: GivenPlane | None = None,
) -> Inputs:
    """As `read_inputs`, but what `checks` refuses is told in the findings and not raised."""
    mesh_file = read_mesh(mesh, mesh_name, limits, beside)
    views: list[View] = []
    findings: list[Finding] = []
    warnings = [*mesh_file.warnings]
    for number, observation in enumerate([Observation(silhouette, camera, ignore), *more_views], 1):
        told = f"view {number}: " if more_views else ""
        try:
            view, odd = _read_view(observation, silhouette_threshold, ignore_grey)
        except InputError as error:
            raise type(error)(f"{told}{error}") from error
        views.append(view)
        found: tuple[Finding, ...] = ()
        if checks != Checks.OFF:  # the mesh has one mirror plane, however many views there are
            plane = symmetry if number == 1 else None
            found = check_inputs(mesh_file.mesh, view, observation.camera, checks, plane)
        findings += [finding.model_copy(update={"message": told + finding.message}) for finding in found]
        warnings += [*(told + warning for warning in odd), *(told + finding.message for finding in found)]
    if ignore_grey is not None and all(view.known is None for view in views):
        warnings.append(f"no pixel of a silhouette has the level {ignore_grey} of ignore_grey")
    return Inputs(mesh_file, tuple(views), tuple(warnings), tuple(findings))


def read_view(
    silhouette: bytes,
    camera: CameraSpec,
    threshold: float = SILHOUETTE_THRESHOLD,
    ignore_grey: int | None = None,
    ignore: bytes | None = None,
) -> View:
    """A silhouette image and the camera that saw it; raises SilhouetteInvalid or CameraInvalid."""
    return _read_view(Observation(silhouette, camera, ignore), threshold, ignore_grey)[0]


def _read_view(
    observation: Observation, threshold: float, ignore_grey: int | None
) -> tuple[View, tuple[str, ...]]:
    """The view, and what is odd about its silhouette."""
    read = read_silhouette(observation.silhouette, threshold, ignore_grey, observation.ignore)
    height, width = read.coverage.shape
    return View(read.coverage, camera_from_spec(observation.camera, width, height), read.known), read.warnings


def _about_the_result(result: Result) -> Iterator[str]:
    """What to think of a result that agrees less with the silhouettes than it should."""
    before, after = result.silhouette_iou_before, result.silhouette_iou_after
    advice = "look at it before you use it, and check the camera and the silhouette"
    if after < before:
        yield f"the 2D IoU of the result fell from {before:.3f} to {after:.3f}: {advice}"
    elif after < POOR_IOU:
        yield f"the 2D IoU of the result is only {after:.3f}: {advice}"
