"""The six losses, one pure function each, means over their elements (paper, section 3.3 and 3.4)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ..kernels import image_symmetry
from ..kernels.oracle import alpha, confidence_cost
from .topology import Topology

__all__ = [
    "displacement",
    "fold_angles",
    "fold_change",
    "image_symmetry",
    "laplacian",
    "normal_consistency",
    "silhouette",
    "silhouette_pyramid",
    "vertex_symmetry",
]

LEAST_DEPTH = 1e-4  # optical depth of a pixel at the edge of a face's reach; beyond it a miss costs no more
SLIVER = 1e-2  # height over length below which a triangle's normal counts less and less


def silhouette(optical_depth: Tensor, target: Tensor, known: Tensor) -> Tensor:
    """Binary cross entropy of alpha = 1 - exp(-S) against the target, mean over the pixels that are known.

    -log(1 - alpha) = S exactly, and -log(alpha) = -log(-expm1(-S)): nothing saturates. All (B, N, N).
    """
    outside = optical_depth
    inside = -torch.log(-torch.expm1(-optical_depth.clamp_min(LEAST_DEPTH)))
    cross_entropy = target * inside + (1 - target) * outside
    return (cross_entropy * known).sum() / known.sum()


def silhouette_pyramid(optical_depth: Tensor, target: Tensor, known: Tensor, levels: int = 6) -> Tensor:
    """Squared difference of alpha and target, relative to the object's area, mean over an image pyramid.

    A level halves the one below by means of 2 x 2: an outline that is far off still makes a difference
    there, whichever side it is on. A level of odd size leaves its last row and column to the level below it.
    All (B, N, N), N at least 2^(levels - 1).
    """
    difference = (known * (alpha(optical_depth) - target))[:, None]
    total = difference.square().mean()
    for _ in range(levels - 1):
        difference = F.avg_pool2d(difference, 2)
        total = total + difference.square().mean()
    return total / levels / target.mean()


def vertex_symmetry(
    vertices: Tensor, nearest: Tensor, mirror: Tensor, confidence: Tensor, cost: float
) -> Tensor:
    """Mean over v of sigma_v min_u |T v - u|^2 + lambda_B ln(1 / sigma_v).

    vertices (V, 3), nearest (V,) index of u for each v, mirror (3, 3) = T, confidence (V,).
    """
    distance2 = (vertices @ mirror - vertices[nearest]).square().sum(1)
    return (confidence * distance2 + confidence_cost(confidence, cost)).mean()


def displacement(offsets: Tensor) -> Tensor:
    """Mean squared displacement per coordinate. (V, 3)"""
    return offsets.square().mean()


def normal_consistency(vertices: Tensor, topology: Topology) -> Tensor:
    """Mean over hinges of 1 - cos of the fold angle; from the shared edge, so the winding does not matter."""
    cos, _ = fold_angles(vertices, topology)
    return (1 - cos).mean() if len(cos) else cos.sum()


def fold_change(vertices: Tensor, topology: Topology, before: tuple[Tensor, Tensor]) -> Tensor:
    """Mean over hinges of 1 - cos of the change of the fold angle since `before`, from `fold_angles`."""
    cos, sin = fold_angles(vertices, topology)
    if not len(cos):
        return cos.sum()
    rest = (before[0].square() + before[1].square()).clamp_min(SLIVER).sqrt()
    return (rest - (cos * before[0] + sin * before[1]) / rest).mean()


def fold_angles(vertices: Tensor, topology: Topology) -> tuple[Tensor, Tensor]:
    """Cosine and sine (P,) of the fold angle at each hinge, zero where it is flat; both shrink at slivers."""
    start, end, one, other = vertices[topology.hinges].unbind(1)  # (P, 3) each
    edge = end - start
    normal, opposite = _unit_normal(edge, one - start), -_unit_normal(edge, other - start)
    along = F.normalize(edge, dim=1, eps=1e-9)
    return (normal * opposite).sum(1), (torch.linalg.cross(normal, opposite) * along).sum(1)


def _unit_normal(side: Tensor, other_side: Tensor) -> Tensor:
    """Of triangles (P, 3); shorter than 1 for a sliver, down to 0, so that its gradient stays bounded.

    The normal of a triangle without area is noise, and its derivative infinite: a single one would decide
    what the optimiser does.
    """
    normal = torch.linalg.cross(side, other_side)
    longest2 = torch.maximum(side.detach().square().sum(1), other_side.detach().square().sum(1))
    least = (SLIVER * longest2).clamp_min(1e-12)
    unit: Tensor = normal / torch.maximum(normal.norm(dim=1), least)[:, None]
    return unit


def laplacian(vertices: Tensor, neighbour_mean: Tensor) -> Tensor:
    """Uniform Laplacian: mean over v of |mean of its neighbours - v|. Both (V, 3)."""
    return ((neighbour_mean - vertices).square().sum(1) + 1e-12).sqrt().mean()
