"""What is fixed during a run: the normalised frame, the views as square targets, the symmetry views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..cameras.project import project, reflect, stack
from ..cameras.seen import seen_by
from ..errors import CameraInvalid
from ..kernels import optical_depth
from ..values import Camera, Mesh, MirrorPlane, View
from .config import RefineConfig
from .symmetry import rotation_from_z


@dataclass(frozen=True)
class Frame:
    """The normalised frame: x_normalised = (x - centre) / scale. Its mirror plane goes through the origin."""

    centre: Tensor  # (3,) world
    scale: float  # longest side of `Mesh.box`, world units

    @staticmethod
    def of(mesh: Mesh, plane: MirrorPlane | None) -> Frame:
        """The unit box of the mesh, moved along the plane's normal so that the plane holds the origin."""
        low, high = mesh.box()
        middle = (low + high) / 2
        if plane is not None:
            middle = middle + (plane.offset - middle @ plane.normal) * plane.normal
        return Frame(middle, float((high - low).max()))

    def normalise(self, vertices: Tensor) -> Tensor:
        """World (V, 3) -> normalised (V, 3)."""
        return (vertices - self.centre) / self.scale

    def world(self, vertices: Tensor) -> Tensor:
        """Normalised (V, 3) -> world (V, 3)."""
        return vertices * self.scale + self.centre

    def camera(self, world_to_camera: Tensor) -> Tensor:
        """The camera moved along: (4, 4) whose unit of length is `scale`."""
        moved = world_to_camera.to(self.centre)
        moved = moved.clone()
        moved[:3, 3] = (moved[:3, :3] @ self.centre + moved[:3, 3]) / self.scale
        return moved


@dataclass(frozen=True)
class Region:
    """A square of a view's image, in whole pixels; it may reach beyond the image."""

    left: int
    top: int
    side: int

    @staticmethod
    def whole(camera: Camera) -> Region:
        """The whole image, padded to a square."""
        side = max(camera.width, camera.height)
        return Region(-((side - camera.width) // 2), -((side - camera.height) // 2), side)

    @staticmethod
    def around(view: View, mesh: Mesh) -> Region:
        """The object with a margin of a tenth: where the silhouette is, and where the mesh is seen."""
        camera = view.camera
        rows, columns = view.object().nonzero().unbind(1)
        covered = seen_by(mesh, [camera]).face[0] >= 0
        if covered.any():
            more_rows, more_columns = covered.nonzero().unbind(1)
            rows, columns = torch.cat([rows, more_rows]), torch.cat([columns, more_columns])
        top, bottom = int(rows.min()), int(rows.max()) + 1
        left, right = int(columns.min()), int(columns.max()) + 1
        side = math.ceil(1.2 * max(bottom - top, right - left))
        return Region((left + right - side) // 2, (top + bottom - side) // 2, side)


@dataclass(frozen=True)
class Target:
    """The input views as square images of one size."""

    silhouette: Tensor  # (B, N, N) coverage in [0, 1] of what is known
    known: Tensor  # (B, N, N) share that is known: 0 beyond the input image and where the view does not know
    world_to_camera: Tensor  # (B, 4, 4) normalised frame
    intrinsics: Tensor  # (B, 4) pixels of the square image
    orthographic: bool

    @staticmethod
    def of(views: Sequence[View], regions: Sequence[Region], frame: Frame, side: int) -> Target:
        """The regions of the views, drawn at `side` x `side` pixels."""
        images, known, intrinsics = [], [], []
        for view, region in zip(views, regions, strict=True):
            camera = view.camera
            pad = (
                -region.left,
                region.left + region.side - camera.width,
                -region.top,
                region.top + region.side - camera.height,
            )  # beyond each border; negative: cut off
            image, seen = _padded(view, pad, side)
            images.append(image)
            known.append(seen)
            zoom = side / region.side
            unit = zoom * (frame.scale if camera.projection == "orthographic" else 1.0)
            centre = (camera.cx - region.left) * zoom, (camera.cy - region.top) * zoom
            intrinsics.append([camera.fx * unit, camera.fy * unit, *centre])
        return Target(
            torch.stack(images),
            torch.stack(known),
            torch.stack([frame.camera(view.camera.world_to_camera) for view in views]),
            frame.centre.new_tensor(intrinsics),
            _one_projection(views) == "orthographic",
        )

    def background(self) -> Tensor:
        """(B, N, N) bool: known, and not on the object."""
        return (self.silhouette <= 0.5) & (self.known > 0.5)

    @property
    def side(self) -> int:
        """N, pixels."""
        return self.silhouette.shape[1]

    def project(self, vertices: Tensor, world_to_camera: Tensor | None = None) -> Tensor:
        """Screen coordinates (B, V, 3) of normalised vertices (V, 3), by these or other cameras (B, 4, 4)."""
        cameras = self.world_to_camera if world_to_camera is None else world_to_camera
        return project(vertices, cameras, self.intrinsics, self.orthographic)

    def optical_depth(self, vertices: Tensor, faces: Tensor, softness: float) -> Tensor:
        """(B, N, N), see `silhouette`."""
        return optical_depth(self.project(vertices), faces, self.side, softness)


def _padded(view: View, pad: tuple[int, int, int, int], side: int) -> tuple[Tensor, Tensor]:
    """Coverage and the share that is known (N, N) of a view padded to a square of `side` pixels."""
    if view.known is None:
        everywhere = torch.ones_like(view.silhouette)
        return resize(F.pad(view.silhouette, pad), side), resize(F.pad(everywhere, pad), side)
    known = resize(F.pad(view.known.to(view.silhouette), pad), side)
    image = resize(F.pad(view.object().to(view.silhouette), pad), side)
    return image / known.clamp_min(1e-6), known  # a pixel that is half unknown shows what its other half does


def _one_projection(views: Sequence[View]) -> str:
    kinds = sorted({view.camera.projection for view in views})
    if len(kinds) != 1:
        raise CameraInvalid(f"expected all views of one run to have one kind of projection, got {kinds}")
    return kinds[0]


def resize(image: Tensor, side: int) -> Tensor:
    """A square image (L, L) at another size: mean over the area when shrinking, bilinear when growing."""
    if len(image) == side:
        return image
    if len(image) > side:
        return F.interpolate(image[None, None], (side, side), mode="area")[0, 0]
    return F.interpolate(image[None, None], (side, side), mode="bilinear", align_corners=False)[0, 0]


@dataclass(frozen=True)
class SymmetryViews:
    """The m view pairs of the image symmetry loss: cameras p, then their reflections T p; normalised frame.

    The rig is the paper's for the mirror normal +Z, turned with the plane for any other normal.
    """

    world_to_camera: Tensor  # (2m, 4, 4)
    intrinsics: Tensor  # (2m, 4)

    @staticmethod
    def of(config: RefineConfig, side: int, normal: Tensor) -> SymmetryViews:
        cameras = [
            Camera.look_at(
                azimuth, elevation, config.symmetry_distance, config.symmetry_fov_degrees, side, side
            )
            for azimuth in config.symmetry_azimuths_degrees
            for elevation in config.symmetry_elevations_degrees
        ]
        matrices, intrinsics = stack(cameras, normal.device)
        matrices[:, :3, :3] = matrices[:, :3, :3] @ rotation_from_z(normal).T
        return SymmetryViews(torch.cat([matrices, reflect(matrices, normal)]), intrinsics.repeat(2, 1))

    def project(self, vertices: Tensor) -> Tensor:
        """Screen coordinates (2m, V, 3) of normalised vertices (V, 3)."""
        return project(vertices, self.world_to_camera, self.intrinsics)
