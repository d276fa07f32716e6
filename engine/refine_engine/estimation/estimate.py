"""The camera that saw a silhouette, from the silhouette and the mesh alone.

Every direction of the sphere is tried with the object placed where the silhouette is; the best few are
improved by the differentiable renderer. A silhouette is the same from the other side, mirrored, as far as
the perspective is weak: of a symmetric object it hardly tells a view from above from one from below. These
views are looked at too, and of equals the camera at a usual elevation is the likelier one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..cameras.seen import silhouette_iou
from ..checks.look import thinned
from ..method.planes import find_mirror_plane
from ..values import Camera, Mesh, View, focal_length
from .cutout import Cutout
from .place import sphere
from .polish import difference, polish
from .poses import Poses

DIRECTIONS = 600  # of the sphere, 8 degrees apart
SIDE = 64  # of the pictures, pixels
CANDIDATES = 12  # of the directions are improved
ALTERNATIVES = 4  # are told of at most
APART_DEGREES = 15.0  # these are from each other
USUAL_FOV_Y_DEGREES = 45.0  # taken, and improved, where it is not known: phones and networks are about there
ROUGH_AZIMUTH_DEGREES = 45.0  # about a hint
ROUGH_ELEVATION_DEGREES = 30.0
USUAL_ELEVATIONS_DEGREES = (-5.0, 40.0)
UNUSUAL_IOU = 0.05  # of 2D IoU: what 30 degrees and more outside of these cost a direction
UNUSUAL_DIFFERENCE = 0.2  # of `difference`: what they cost an improved pose
MIRRORED_DEGREES = 20.0  # from the mirror image of a direction: it is that one, on a mesh that is not exact
AS_GOOD_IOU = 0.05  # by which the mirror image may be worse
MANY_FACES = 5000  # a mesh with more is thinned out before it is drawn so often
CELLS = 48  # of its longest side, when it is


@dataclass(frozen=True)
class Hint:
    """What is known of the camera; angles as of `Camera.look_at`, but about the middle of the object."""

    fov_y_degrees: float | None = None  # exactly
    azimuth_degrees: float | None = None  # roughly
    elevation_degrees: float | None = None  # roughly
    roll_degrees: float = 0.0  # exactly; clockwise turn about the viewing direction

    def allows(self, directions: Tensor) -> Tensor:
        """(B,) bool: the directions (B, 3) that are roughly there."""
        azimuth, elevation = angles(directions)
        near = torch.ones_like(azimuth, dtype=torch.bool)
        if self.azimuth_degrees is not None:
            off = (azimuth - self.azimuth_degrees + 180) % 360 - 180
            near &= off.abs() <= ROUGH_AZIMUTH_DEGREES
        if self.elevation_degrees is not None:
            near &= (elevation - self.elevation_degrees).abs() <= ROUGH_ELEVATION_DEGREES
        return near

    def against(self, directions: Tensor) -> Tensor:
        """(B,) what speaks against the directions (B, 3): infinite, or from 0 to 1 by a usual elevation."""
        unusual = torch.zeros(len(directions))
        if self.elevation_degrees is None:
            elevation, (low, high) = angles(directions)[1], USUAL_ELEVATIONS_DEGREES
            unusual = ((low - elevation).clamp(0, 30) + (elevation - high).clamp(0, 30)) / 30
        return torch.where(self.allows(directions), unusual, torch.inf)


@dataclass(frozen=True)
class Candidate:
    """A camera that may be the one."""

    camera: Camera
    silhouette_iou: float  # 2D IoU of the mesh seen by it
    azimuth_degrees: float  # as in a Hint
    elevation_degrees: float
    mirror_ambiguous: bool = False  # the best one's view from the other side or mirrored, and as good


def estimate_camera(
    mesh: Mesh, silhouette: Tensor, known: Tensor | None = None, hint: Hint = Hint()
) -> list[Candidate]:
    """Cameras for a silhouette, the likeliest first, then runners-up in other directions.

    `silhouette` (H, W) float32 with an object, `known` (H, W) bool or None as in `View`; all on the CPU.
    The principal point is the middle of the image. Takes seconds whatever the size of the mesh. Raises
    SilhouetteInvalid for a silhouette without an object or without a background.
    """
    height, width = silhouette.shape
    View(silhouette, Camera.look_at(0.0, 0.0, 1.0, 60.0, width, height), known)  # raises if nothing is seen
    low, high = mesh.box()
    centre, scale = (low + high) / 2, float((high - low).max())
    unit = thinned(Mesh((mesh.vertices - centre) / scale, mesh.faces), MANY_FACES, CELLS)
    wanted = silhouette > 0.5 if known is None else (silhouette > 0.5) & known
    cutout = Cutout.of(wanted, known, SIDE)
    plane = find_mirror_plane(mesh)
    normal = None if plane is None else plane.normal

    directions = sphere(DIRECTIONS)
    directions = directions[hint.allows(directions)]
    overlap = _placed(unit, cutout, directions, hint).overlap(unit, cutout)
    badness = UNUSUAL_IOU * hint.against(directions) - overlap
    poses = _improved(unit, cutout, directions[_distinct(directions, badness, CANDIDATES)], hint)
    best, _ = _best(poses, unit, cutout, hint)
    mirrors = mirrored(poses.directions()[best], normal)
    poses = Poses.cat([poses, _improved(unit, cutout, mirrors, hint)])
    best, left = _best(poses, unit, cutout, hint)
    left[best] = -1.0  # first; a caller knows better which of the others is unusual
    poses = poses[_distinct(poses.directions(), left, 1 + ALTERNATIVES)]

    cameras = [_in_world(poses[[i]], centre, scale, silhouette) for i in range(len(poses))]
    ious = [silhouette_iou(mesh, View(silhouette, camera, known)) for camera in cameras]
    mirrors = mirrored(poses.directions()[0], normal)
    near = (poses.directions() @ mirrors.T).amax(1) > math.cos(math.radians(MIRRORED_DEGREES))
    azimuth, elevation = angles(poses.directions())
    return [
        Candidate(
            camera,
            ious[i],
            float(azimuth[i]),
            float(elevation[i]),
            i > 0 and bool(near[i]) and ious[i] > ious[0] - AS_GOOD_IOU,
        )
        for i, camera in enumerate(cameras)
    ]


def angles(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth and elevation (B,), degrees, of directions (B, 3)."""
    azimuth = torch.atan2(directions[:, 0], directions[:, 2])
    return azimuth.rad2deg(), directions[:, 1].clamp(-1, 1).asin().rad2deg()


def mirrored(direction: Tensor, normal: Tensor | None) -> Tensor:
    """Directions (M, 3) with the silhouette of a direction (3,), or its mirror image, from far enough away.

    From behind every object shows its mirrored silhouette; and one that its mirror plane (normal (3,))
    mirrors does so from the mirrored direction. From behind that the silhouette is the same.
    """
    if normal is None:
        return -direction[None]
    other = direction - 2 * (direction @ normal) * normal
    return torch.stack([-other, -direction, other])


def _placed(unit: Mesh, cutout: Cutout, directions: Tensor, hint: Hint) -> Poses:
    fov = hint.fov_y_degrees or USUAL_FOV_Y_DEGREES
    return Poses.of(unit, cutout, directions, fov, hint.roll_degrees)


def _improved(unit: Mesh, cutout: Cutout, directions: Tensor, hint: Hint) -> Poses:
    poses = _placed(unit, cutout, directions, hint)
    return polish(poses, unit, cutout, hint.roll_degrees, hint.fov_y_degrees is not None)


def _best(poses: Poses, unit: Mesh, cutout: Cutout, hint: Hint) -> tuple[int, Tensor]:
    """The likeliest pose, and the difference (B,) that each leaves."""
    left = difference(poses, unit, cutout)
    return int((left + UNUSUAL_DIFFERENCE * hint.against(poses.directions())).argmin()), left


def _distinct(directions: Tensor, badness: Tensor, count: int) -> list[int]:
    """The best ones that are APART_DEGREES from every better one, at most `count`."""
    least = math.cos(math.radians(APART_DEGREES))
    chosen: list[int] = []
    for i in badness.argsort(stable=True).tolist():
        if all(float(directions[i] @ directions[j]) < least for j in chosen):
            chosen.append(i)
        if len(chosen) == count:
            break
    return chosen


def _in_world(pose: Poses, centre: Tensor, scale: float, silhouette: Tensor) -> Camera:
    """One pose of the unit frame as a camera of the world, for the image (H, W)."""
    height, width = silhouette.shape
    matrix = torch.eye(4)
    matrix[:3, :3] = pose.rotation[0]
    matrix[:3, 3] = pose.translation[0] * scale - pose.rotation[0] @ centre
    f = focal_length(float(pose.fov_y_degrees[0]), height)
    return Camera(matrix, f, f, width / 2, height / 2, width, height)
