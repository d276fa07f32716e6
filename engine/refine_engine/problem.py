"""What is fixed during a run: the mesh in its normalised frame, the views as square targets, the mirror plane."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from . import symmetry
from .cameras import reflect, stack
from .config import RefineConfig
from .scene import Camera, Mesh, View


@dataclass(frozen=True)
class Frame:
    """The normalised frame: x_normalised = (x - centre) / scale. Its mirror plane goes through the origin."""

    centre: Tensor  # (3,) world
    scale: float  # longest side of the bounding box, world units

    @staticmethod
    def of(mesh: Mesh, config: RefineConfig) -> Frame:
        used = mesh.vertices[mesh.faces.unique()]
        low, high = used.amin(0), used.amax(0)
        normal = unit_normal(config, used)
        offset = config.symmetry_offset
        if offset is None:
            offset = symmetry.least_mirrored_offset(mesh, normal)
        middle = (low + high) / 2
        return Frame(middle + (offset - middle @ normal) * normal, float((high - low).max()))

    def normalise(self, vertices: Tensor) -> Tensor:
        return (vertices - self.centre) / self.scale

    def camera(self, world_to_camera: Tensor) -> Tensor:
        """The camera moved along: (4, 4) whose unit of length is `scale`."""
        moved = world_to_camera.clone()
        rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
        moved[:3, 3] = (rotation @ self.centre.to(rotation) + translation) / self.scale
        return moved


def unit_normal(config: RefineConfig, like: Tensor) -> Tensor:
    return F.normalize(torch.tensor(config.symmetry_normal, dtype=like.dtype, device=like.device), dim=0)


@dataclass(frozen=True)
class Target:
    """The input views as square images of one size, the whole image padded to a square."""

    silhouette: Tensor  # (B, N, N) coverage in [0, 1]
    known: Tensor  # (B, N, N) 1 inside the input image, 0 in the padding
    world_to_camera: Tensor  # (B, 4, 4) normalised frame
    intrinsics: Tensor  # (B, 4) pixels of the square image
    orthographic: bool

    @staticmethod
    def of(views: list[View], frame: Frame, side: int) -> Target:
        images, known, intrinsics = [], [], []
        for view in views:
            camera = view.camera
            longest = max(camera.width, camera.height)
            left, top = (longest - camera.width) // 2, (longest - camera.height) // 2
            pad = (left, longest - camera.width - left, top, longest - camera.height - top)
            images.append(resize(F.pad(view.silhouette, pad), side))
            known.append(resize(F.pad(torch.ones_like(view.silhouette), pad), side))
            unit = frame.scale if camera.projection == "orthographic" else 1.0
            scale = side / longest
            intrinsics.append(
                [camera.fx * unit * scale, camera.fy * unit * scale,
                 (camera.cx + left) * scale, (camera.cy + top) * scale]
            )
        device = views[0].silhouette.device
        matrices = torch.stack([frame.camera(v.camera.world_to_camera.float().to(device)) for v in views])
        return Target(
            torch.stack(images), torch.stack(known), matrices,
            torch.tensor(intrinsics, dtype=torch.float32, device=device),
            views[0].camera.projection == "orthographic",
        )


def resize(image: Tensor, side: int) -> Tensor:
    """A square image (L, L) at another size: mean over the area when shrinking, bilinear when growing."""
    if len(image) == side:
        return image
    if len(image) > side:
        return F.adaptive_avg_pool2d(image[None, None], side)[0, 0]
    return F.interpolate(image[None, None], (side, side), mode="bilinear", align_corners=False)[0, 0]


def symmetry_views(config: RefineConfig, side: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras p (m, 4, 4), their reflections T p (m, 4, 4) and intrinsics (m, 4), normalised frame.

    The rig is the paper's for the normal +Z, turned with the plane for any other normal.
    """
    cameras = [
        Camera.look_at(a, e, config.symmetry_distance, config.symmetry_fov_degrees, side, side)
        for a in config.symmetry_azimuths_degrees
        for e in config.symmetry_elevations_degrees
    ]
    matrices, intrinsics = stack(cameras, device)
    normal = unit_normal(config, matrices)
    turned = matrices.clone()
    turned[:, :3, :3] = matrices[:, :3, :3] @ rotation_from_z(normal).T
    return turned, reflect(turned, normal), intrinsics


def rotation_from_z(normal: Tensor) -> Tensor:
    """The smallest rotation that takes +Z to the unit normal: (3,) -> (3, 3). For -Z the identity."""
    x, y, z = normal.tolist()
    if z < -1 + 1e-6:
        return torch.eye(3, dtype=normal.dtype, device=normal.device)
    k = 1 / (1 + z)
    rows = [[1 - k * x * x, -k * x * y, x], [-k * x * y, 1 - k * y * y, y], [-x, -y, z]]
    return torch.tensor(rows, dtype=normal.dtype, device=normal.device)
