"""The mirror plane, and the nearest vertex of each mirrored vertex."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from .scene import Mesh

DENSE_LIMIT = 3000  # vertices up to which all distances at once are cheaper than a tree


def mirror_matrix(normal: Tensor) -> Tensor:
    """T = I - 2 n n^T (3, 3) for a unit normal (3,)."""
    return torch.eye(3, dtype=normal.dtype, device=normal.device) - 2 * torch.outer(normal, normal)


def nearest_mirrored(vertices: Tensor, mirror: Tensor) -> Tensor:
    """For each v the index of the vertex u nearest to T v: (V, 3) -> (V,) int64. Not differentiable."""
    points = vertices.detach()
    mirrored = points @ mirror
    if points.device.type == "cpu" and len(points) > DENSE_LIMIT:
        _, index = cKDTree(points.numpy()).query(mirrored.numpy())
        return torch.from_numpy(index)
    half_norm = 0.5 * points.square().sum(1)  # |T v - u|^2 / 2 less |T v|^2 / 2
    return (half_norm - mirrored @ points.T).argmin(1)


def least_mirrored_offset(mesh: Mesh, normal: Tensor, samples: int = 2000) -> float:
    """Offset d of the plane n.x = d for which the mirrored coarse mesh is nearest to itself, world units.

    Mean distance from mirrored surface points to the surface points, on a grid of offsets that is refined
    around its best value five times.
    """
    points = surface_points(mesh, samples).double().cpu()
    n = normal.double().cpu()
    tree = cKDTree(points.numpy())
    height = points @ n

    def cost(offset: float) -> float:
        mirrored = points - 2 * (height - offset)[:, None] * n
        return float(tree.query(mirrored.numpy())[0].mean())

    centre = float(height.amin() + height.amax()) / 2
    span = float(height.amax() - height.amin()) / 4
    for _ in range(5):
        candidates = [centre + span * k / 4 for k in range(-4, 5)]
        centre = min(candidates, key=cost)
        span /= 3
    return centre


def surface_points(mesh: Mesh, samples: int) -> Tensor:
    """`samples` points spread over the surface by area, the same for the same mesh: (samples, 3)."""
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    steps = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples * area.sum().cpu()
    face = torch.searchsorted(area.cumsum(0).cpu(), steps).clamp_max(len(area) - 1).to(a.device)
    # low-discrepancy position inside the face (R2 sequence, folded into the triangle)
    k = torch.arange(1, samples + 1, dtype=torch.float64, device=a.device)
    u, v = (k * 0.7548776662466927) % 1, (k * 0.5698402909980532) % 1
    fold = u + v > 1
    u, v = torch.where(fold, 1 - u, u), torch.where(fold, 1 - v, v)
    return a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
