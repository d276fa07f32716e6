"""Does the camera see the object at all? Asked before minutes are spent on a camera read the wrong way."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from refine_proto.cameras import CameraSpec

from ..errors import ObjectOutOfView
from ..values import Camera, Mesh, View
from .seen import seen_by
from .spec import other_readings

LONGEST_SIDE = 224  # of the images compared, pixels
SUSPICIOUS_IOU = 0.1  # a coarse mesh seen by its true camera overlaps more than this
CONVINCING_IOU = 0.5  # and by a camera that is only roughly right less than this


def check_in_view(mesh: Mesh, view: View, spec: CameraSpec) -> str | None:
    """A warning when `spec`, from which `view.camera` was read, looks as if written in another convention.

    Compares the hard render of the mesh with the silhouette by their 2D IoU. Raises ObjectOutOfView when the
    render is empty: the object is behind the camera or beside the image. Either message names the reading of
    the same numbers that fits the silhouette best, if one fits well.
    """
    silhouette = _shrink(view.silhouette)
    rendered = _covered(mesh, [view.camera], silhouette)
    iou = float(_iou(rendered, silhouette))
    if iou >= SUSPICIOUS_IOU:
        return None
    others = other_readings(spec, view.camera)
    scores = _iou(_covered(mesh, list(others.values()), silhouette), silhouette).tolist()
    best, best_iou = max(zip(others, scores, strict=True), key=lambda scored: scored[1])
    hint = f"; did you mean {best}? it gives a 2D IoU of {best_iou:.2f}" if best_iou > CONVINCING_IOU else ""
    if not rendered.any():
        raise ObjectOutOfView(f"expected the object in the image, got {_where(mesh, view.camera)}{hint}")
    if hint:
        return f"the coarse mesh and the silhouette have a 2D IoU of only {iou:.2f}{hint}"
    return None


def _shrink(silhouette: Tensor) -> Tensor:
    """(H, W) coverage -> the same picture as bool, its longest side at most LONGEST_SIDE."""
    height, width = silhouette.shape
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    return F.adaptive_avg_pool2d(silhouette[None], size)[0] > 0.5


def _covered(mesh: Mesh, cameras: Sequence[Camera], like: Tensor) -> Tensor:
    """Which pixels the mesh covers, in images of the size of `like`: (B, H, W) bool."""
    return seen_by(mesh, cameras, (like.shape[0], like.shape[1])).face >= 0


def _iou(rendered: Tensor, silhouette: Tensor) -> Tensor:
    """2D IoU of each of (B, H, W) with (H, W): (B,)."""
    both = (rendered & silhouette).flatten(1).sum(1)
    either = (rendered | silhouette).flatten(1).sum(1)
    return both / either.clamp_min(1)


def _where(mesh: Mesh, camera: Camera) -> str:
    """Of a mesh that the camera does not see: where it is instead."""
    vertices = mesh.vertices[torch.unique(mesh.faces)]
    depth = vertices @ camera.world_to_camera[2, :3].to(vertices) + camera.world_to_camera[2, 3].to(vertices)
    nearest, farthest = float(depth.min()), float(depth.max())
    if farthest <= 0.0:
        return "one that is entirely behind the camera"
    if nearest <= 0.0:
        return f"one around the camera, from depth {nearest:.3g} to {farthest:.3g}"
    return f"one that lies outside the {camera.width}x{camera.height} pixels"
