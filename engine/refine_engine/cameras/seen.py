"""This mesh seen by these cameras: the one hard render behind the 2D IoU, the pictures and the camera checks.

The mesh is drawn in the unit frame, `Mesh.box` at the origin with a longest side of 1 and the cameras
moved along. So a scene in millimetres looks as the same scene in kilometres does: the renderer's least depth
is a length of the unit frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..kernels import Fragments, rasterize
from ..values import Camera, Mesh, View
from .project import project


def seen_by(mesh: Mesh, cameras: Sequence[Camera], size: tuple[int, int] | None = None) -> Fragments:
    """What cameras of one image size and one projection see of the mesh: Fragments (B, H, W).

    `size` (height, width) draws the cameras' whole images at another size than their own.
    """
    first = cameras[0]
    height, width = size or (first.height, first.width)
    low, high = mesh.box()
    centre, scale = (low + high) / 2, float((high - low).max())
    matrices = torch.stack([camera.world_to_camera.to(mesh.vertices) for camera in cameras])
    matrices[:, :3, 3] = (matrices[:, :3, :3] @ centre + matrices[:, :3, 3]) / scale
    orthographic = first.projection == "orthographic"
    unit = scale if orthographic else 1.0  # of fx and fy: pixels per world unit, or of a ratio of lengths
    intrinsics = mesh.vertices.new_tensor([[c.fx * unit, c.fy * unit, c.cx, c.cy] for c in cameras])
    x, y = width / first.width, height / first.height
    intrinsics = intrinsics * intrinsics.new_tensor([x, y, x, y])
    screen = project((mesh.vertices - centre) / scale, matrices, intrinsics, orthographic)
    return rasterize(screen, mesh.faces, (height, width), orthographic)


def hard_silhouette(mesh: Mesh, camera: Camera) -> Tensor:
    """The pixels (H, W) bool whose centre the mesh covers; not the soft silhouette of the optimisation."""
    return seen_by(mesh, [camera]).face[0] >= 0


def silhouette_iou(mesh: Mesh, view: View) -> float:
    """2D IoU of what is known: `hard_silhouette` of the mesh from the view's camera against the object."""
    covered, wanted = hard_silhouette(mesh, view.camera), view.object()
    if view.known is not None:
        covered = covered & view.known
    return float((covered & wanted).sum() / (covered | wanted).sum())


def mean_silhouette_iou(mesh: Mesh, views: Sequence[View]) -> float:
    """2D IoU of hard renders, mean over the views."""
    return sum(silhouette_iou(mesh, view) for view in views) / len(views)
