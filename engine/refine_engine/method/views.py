"""What is fixed during a run: the normalised frame, the views as square targets, the symmetry views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..cameras.project import project, reflect, stack
from ..errors import CameraInvalid
from ..kernels import optical_depth
from ..values import Camera, Mesh, View
from . import symmetry
from .config import RefineConfig


@dataclass(frozen=True)
class Frame:
    """The normalised frame: x_normalised = (x - centre) / scale. Its mirror plane goes through the origin."""

    centre: Tensor  # (3,) world
    scale: float  # longest side of the bounding box, world units
    normal: Tensor  # (3,) unit normal of the mirror plane

    @staticmethod
    def of(mesh: Mesh, config: RefineConfig) -> Frame:
        used = mesh.vertices[mesh.faces.unique()]
        low, high = used.amin(0), used.amax(0)
        normal = F.normalize(used.new_tensor(config.symmetry_normal), dim=0)
        offset = config.symmetry_offset
        if offset is None:
            offset = symmetry.least_mirrored_offset(mesh, normal)
        middle = (low + high) / 2
        return Frame(middle + (offset - middle @ normal) * normal, float((high - low).max()), normal)

    def normalise(self, vertices: Tensor) -> Tensor:
        return (vertices - self.centre) / self.scale

    def camera(self, world_to_camera: Tensor) -> Tensor:
        """The camera moved along: (4, 4) whose unit of length is `scale`."""
        moved = world_to_camera.to(self.centre)
        moved = moved.clone()
        moved[:3, 3] = (moved[:3, :3] @ self.centre + moved[:3, 3]) / self.scale
        return moved


@dataclass(frozen=True)
class Target:
    """The input views as square images of one size, each whole image padded to a square."""

    silhouette: Tensor  # (B, N, N) coverage in [0, 1]
    known: Tensor  # (B, N, N) 1 inside the input image, 0 in the padding
    world_to_camera: Tensor  # (B, 4, 4) normalised frame
    intrinsics: Tensor  # (B, 4) pixels of the square image
    orthographic: bool

    @staticmethod
    def of(views: Sequence[View], frame: Frame, side: int) -> Target:
        images, known, intrinsics = [], [], []
        for view in views:
            camera = view.camera
            longest = max(camera.width, camera.height)
            left, top = (longest - camera.width) // 2, (longest - camera.height) // 2
            pad = (left, longest - camera.width - left, top, longest - camera.height - top)
            images.append(resize(F.pad(view.silhouette, pad), side))
            known.append(resize(F.pad(torch.ones_like(view.silhouette), pad), side))
            zoom = side / longest
            unit = zoom * (frame.scale if camera.projection == "orthographic" else 1.0)
            centre = (camera.cx + left) * zoom, (camera.cy + top) * zoom
            intrinsics.append([camera.fx * unit, camera.fy * unit, *centre])
        return Target(
            torch.stack(images),
            torch.stack(known),
            torch.stack([frame.camera(view.camera.world_to_camera) for view in views]),
            frame.centre.new_tensor(intrinsics),
            _one_projection(views) == "orthographic",
        )

    @property
    def side(self) -> int:
        """N, pixels."""
        return self.silhouette.shape[1]

    def project(self, vertices: Tensor) -> Tensor:
        """Screen coordinates (B, V, 3) of normalised vertices (V, 3)."""
        return project(vertices, self.world_to_camera, self.intrinsics, self.orthographic)

    def optical_depth(self, vertices: Tensor, faces: Tensor, softness: float) -> Tensor:
        """(B, N, N), see `silhouette`."""
        return optical_depth(self.project(vertices), faces, self.side, softness)


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
        matrices[:, :3, :3] = matrices[:, :3, :3] @ symmetry.rotation_from_z(normal).T
        return SymmetryViews(torch.cat([matrices, reflect(matrices, normal)]), intrinsics.repeat(2, 1))

    def project(self, vertices: Tensor) -> Tensor:
        """Screen coordinates (2m, V, 3) of normalised vertices (V, 3)."""
        return project(vertices, self.world_to_camera, self.intrinsics)
