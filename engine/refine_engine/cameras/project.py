"""Pinhole and orthographic projection, reflected cameras. All batched over views B."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels.oracle import NEAR
from ..values import Camera


def project(
    vertices: Tensor,  # (V, 3) in a frame where the object is about 1 long: NEAR is a length of it
    world_to_camera: Tensor,  # (B, 4, 4) OpenCV axes
    intrinsics: Tensor,  # (B, 4) fx, fy, cx, cy in pixels
    orthographic: bool = False,
) -> Tensor:
    """Screen coordinates (B, V, 3): x right and y down in pixels, z the depth along the viewing direction.

    A vertex at or behind the camera plane is projected as if it were at depth NEAR, so that every value is
    finite; the renderer leaves out the faces that use it.
    """
    rotation, translation = world_to_camera[:, :3, :3], world_to_camera[:, None, :3, 3]
    camera = vertices @ rotation.transpose(1, 2) + translation  # (B, V, 3)
    depth = camera[..., 2:]
    scaled = camera[..., :2] if orthographic else camera[..., :2] / depth.clamp_min(NEAR)
    screen = scaled * intrinsics[:, None, :2] + intrinsics[:, None, 2:]
    return torch.cat([screen, depth], -1)


def reflect(world_to_camera: Tensor, normal: Tensor) -> Tensor:
    """The camera on the other side of the mirror plane n.x = 0, its image flipped left to right.

    With T = I - 2 n n^T (paper, section 3.3), the picture of the mesh by the returned camera equals the
    horizontally flipped picture of the mirrored mesh by the given one. (B, 4, 4) -> (B, 4, 4)
    """
    mirror = torch.eye(4, dtype=normal.dtype, device=normal.device)
    mirror[:3, :3] -= 2 * torch.outer(normal, normal)
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=normal.dtype, device=normal.device))
    return flip @ world_to_camera @ mirror


def stack(cameras: list[Camera], device: torch.device) -> tuple[Tensor, Tensor]:
    """Cameras as tensors: world_to_camera (B, 4, 4) and intrinsics (B, 4)."""
    matrices = torch.stack([c.world_to_camera.float() for c in cameras])
    intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32)
    return matrices.to(device), intrinsics.to(device)
