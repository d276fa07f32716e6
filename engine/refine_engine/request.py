"""The bytes of a request -> what `refine` takes, with every check that is possible before it starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from refine_proto.cameras import CameraSpec, EstimatedCamera
from refine_proto.checks import Checks, Finding
from refine_proto.formats import SILHOUETTE_THRESHOLD

from .cameras.spec import camera_from_spec, spec_of
from .checks.check import GivenPlane, check_inputs, refuse
from .errors import InputError
from .estimation.estimate import AS_GOOD_IOU, Candidate, Hint, estimate_camera
from .files.beside import Beside
from .files.limits import MeshLimits
from .files.mesh_file import MeshFile, read_mesh
from .files.silhouette import Silhouette, read_silhouette
from .method.config import RefineConfig
from .method.loop import Checkpoints
from .proxy.run import refine_any_size
from .values import Mesh, Progress, Result, View, field_of_view, focal_length

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
    estimate: tuple[Candidate, ...] = ()  # the first camera and its alternatives, where it was not given

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
    subdivide: bool = False,
) -> Inputs:
    """Read a mesh file and a silhouette image, for a camera as `read_camera` gives it; and further views.

    `mesh_name` matters for its suffix where the bytes do not tell the format; `beside` gives the files that
    the mesh refers to. See `read_silhouette` for `ignore_grey` and `ignore`. `symmetry` is checked where it
    is given. With `subdivide` the long edges of the mesh are split. Raises an InputError: a file or a camera
    is invalid, or `checks` refuses them together.
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
        subdivide=subdivide,
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
    subdivide: bool = False,
) -> Inputs:
    """As `read_inputs`, but what `checks` refuses is told in the findings and not raised."""
    mesh_file = read_mesh(mesh, mesh_name, limits, beside, subdivide=subdivide)
    views: list[View] = []
    findings: list[Finding] = []
    warnings = [*mesh_file.warnings]
    estimate: tuple[Candidate, ...] = ()
    for number, observation in enumerate([Observation(silhouette, camera, ignore), *more_views], 1):
        told = f"view {number}: " if more_views else ""
        try:
            read = read_silhouette(
                observation.silhouette, silhouette_threshold, ignore_grey, observation.ignore
            )
            if number == 1 and isinstance(camera, EstimatedCamera):
                estimate = _estimate(mesh_file.mesh, read, camera)
                observation = replace(observation, camera=spec_of(estimate[0].camera))
            view = _view(read, observation.camera)
        except InputError as error:
            raise type(error)(f"{told}{error}") from error
        views.append(view)
        found: tuple[Finding, ...] = ()
        if checks != Checks.OFF:  # the mesh has one mirror plane, however many views there are
            plane = symmetry if number == 1 else None
            found = check_inputs(mesh_file.mesh, view, observation.camera, checks, plane)
        findings += [finding.model_copy(update={"message": told + finding.message}) for finding in found]
        warnings += [
            *(told + warning for warning in read.warnings),
            *(told + finding.message for finding in found),
        ]
    if ignore_grey is not None and all(view.known is None for view in views):
        warnings.append(f"no pixel of a silhouette has the level {ignore_grey} of ignore_grey")
    warnings += _about_the_estimate(estimate)
    return Inputs(mesh_file, tuple(views), tuple(warnings), tuple(findings), estimate)


def read_view(
    silhouette: bytes,
    camera: CameraSpec,
    threshold: float = SILHOUETTE_THRESHOLD,
    ignore_grey: int | None = None,
    ignore: bytes | None = None,
) -> View:
    """A silhouette image and the camera that saw it; raises SilhouetteInvalid or CameraInvalid."""
    return _view(read_silhouette(silhouette, threshold, ignore_grey, ignore), camera)


def _view(read: Silhouette, camera: CameraSpec) -> View:
    height, width = read.coverage.shape
    return View(read.coverage, camera_from_spec(camera, width, height), read.known)


def _estimate(mesh: Mesh, read: Silhouette, told: EstimatedCamera) -> tuple[Candidate, ...]:
    fov = told.fov_y_degrees
    if told.fov_x_degrees is not None:
        height, width = read.coverage.shape
        fov = field_of_view(focal_length(told.fov_x_degrees, width), height)
    hint = Hint(fov, told.azimuth_degrees, told.elevation_degrees, told.roll_degrees)
    return tuple(estimate_camera(mesh, read.coverage, read.known, hint))


def _about_the_estimate(estimate: Sequence[Candidate]) -> Iterator[str]:
    """That the camera may as well be another one."""
    others = [
        other for other in estimate[1:] if other.silhouette_iou > estimate[0].silhouette_iou - AS_GOOD_IOU
    ]
    if others:
        where, *also = (
            f"azimuth {one.azimuth_degrees:.0f} and elevation {one.elevation_degrees:.0f} degrees "
            f"(2D IoU {one.silhouette_iou:.2f})"
            for one in (estimate[0], *others)
        )
        yield (
            f"the camera is estimated to be at {where}, but the silhouette fits as well from "
            f"{' or '.join(also)}: give azimuth_degrees and elevation_degrees of the right one, roughly"
        )


def _about_the_result(result: Result) -> Iterator[str]:
    """What to think of a result that agrees less with the silhouettes than it should."""
    before, after = result.silhouette_iou_before, result.silhouette_iou_after
    advice = "look at it before you use it, and check the camera and the silhouette"
    if after < before:
        yield f"the 2D IoU of the result fell from {before:.3f} to {after:.3f}: {advice}"
    elif after < POOR_IOU:
        yield f"the 2D IoU of the result is only {after:.3f}: {advice}"
