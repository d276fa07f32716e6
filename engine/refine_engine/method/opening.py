"""Faces that lie outside the silhouette, where no motion of vertices brings them in.

A network whose meshes are spheres inside spans a web over every hole of an object. Moving vertices cannot
open it: it only tears the rest apart. The silhouette tells: what covers its background, deeper than a wrong
outline would, is not there (Landreau and Tamaazousti 2022, arXiv 2210.09148, prune by the mask as well).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from ..kernels import rasterize
from .config import Opening
from .views import Target

SAMPLES = 8  # a face is looked at in SAMPLES * (SAMPLES + 1) / 2 points


def find_outside(vertices: Tensor, faces: Tensor, target: Target, opening: Opening) -> Tensor:
    """The faces (F,) of normalised vertices (V, 3) that the views of `target` do not see on the object.

    A face is outside when more than `opening.share` of its area lies on background regions which the mesh
    covers and which reach deeper into the background than `opening.depth`. With several views, one is enough.
    """
    screen = target.project(vertices)
    covered = rasterize(screen, faces, (target.side, target.side)).face >= 0
    points = torch.einsum("sc,bfcd->bfsd", _barycentric().to(vertices), screen[:, faces, :2])  # (B, F, S, 2)
    x, y = (points[..., i].floor().long().clamp(0, target.side - 1) for i in (0, 1))
    view = torch.arange(len(screen), device=vertices.device)[:, None, None]
    regions = torch.stack(
        [_regions(*pair, opening) for pair in zip(target.background(), covered, strict=True)]
    )
    outside = (regions[view, y, x].float().mean(2) > opening.share).any(0)
    return outside & ~outside.all()


def find_unexplained(vertices: Tensor, faces: Tensor, target: Target, depth: float) -> Tensor:
    """The pixels (B, N, N) bool of `target` that no small motion of normalised vertices (V, 3) will explain.

    Webs: where the mesh is and the object is farther than `depth` object sizes, with what lies around such a
    place. A lost part does pull: what moves towards it is nearer to the truth than nothing there.
    """
    covered = rasterize(target.project(vertices), faces, (target.side, target.side)).face >= 0
    wanted = torch.where(target.known > 0.5, target.silhouette > 0.5, covered)  # nothing to explain elsewhere
    pairs = zip(wanted, covered, strict=True)
    return torch.stack([_deep(mesh, object_, depth) for object_, mesh in pairs])


def _deep(one: Tensor, other: Tensor, depth: float) -> Tensor:
    """(N, N) bool: the pixels of `one` that are farther than `depth` from `other`, and those around them."""
    if not other.any():
        return one
    rows, columns = one.nonzero().unbind(1)
    if not len(rows):
        return one
    reach = depth * (1 + max(int(rows.max() - rows.min()), int(columns.max() - columns.min())))
    missed = ndimage.distance_transform_edt(~other.cpu().numpy()) * one.cpu().numpy() > reach
    if not missed.any():
        return torch.zeros_like(one)
    around = ndimage.distance_transform_edt(~missed) <= reach + 1
    return torch.from_numpy(around).to(one.device) & one & ~other


def _regions(background: Tensor, covered: Tensor, opening: Opening) -> Tensor:
    """(N, N) bool: connected covered background that reaches deeper than `opening.depth` object sizes."""
    away = ndimage.distance_transform_edt(background.cpu().numpy())
    rows, columns = np.nonzero(away == 0)
    size = max(np.ptp(rows), np.ptp(columns)) + 1
    wrong = (away > opening.outline_px) & covered.cpu().numpy()
    label, _ = ndimage.label(wrong)
    deep = np.unique(label[wrong & (away > opening.depth * size)])
    return torch.from_numpy(np.isin(label, deep[deep > 0])).to(covered.device)


def _barycentric() -> Tensor:
    """(S, 3): points spread evenly over a triangle, the centroids of its lower sub-triangles."""
    pairs = [
        ((i + 1 / 3) / SAMPLES, (j + 1 / 3) / SAMPLES) for i in range(SAMPLES) for j in range(SAMPLES - i)
    ]
    return torch.tensor([[1 - u - v, u, v] for u, v in pairs])
