"""The mirror plane, and the nearest vertex of each mirrored vertex."""

from __future__ import annotations

from collections.abc import Callable

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..kernels import nearest_point
from ..values import Mesh, MirrorPlane

SAMPLES = 2000  # surface points for comparing a mesh with its mirror image
DENSE_SAMPLES = 20_000  # for the distance of one point: apart by a tenth of what counts


def mirror_matrix(normal: Tensor) -> Tensor:
    """T = I - 2 n n^T (3, 3) for a unit normal (3,)."""
    return torch.eye(3, dtype=normal.dtype, device=normal.device) - 2 * torch.outer(normal, normal)


def rotation_from_z(normal: Tensor) -> Tensor:
    """The smallest rotation that takes +Z to the unit normal: (3,) -> (3, 3). For -Z the identity."""
    x, y, z = normal.tolist()
    if z < -1 + 1e-6:
        return torch.eye(3, dtype=normal.dtype, device=normal.device)
    k = 1 / (1 + z)
    return normal.new_tensor([[1 - k * x * x, -k * x * y, x], [-k * x * y, 1 - k * y * y, y], [-x, -y, z]])


def nearest_mirrored(vertices: Tensor, mirror: Tensor) -> Tensor:
    """For each v the index of the vertex u nearest to T v: (V, 3) -> (V,) int64. Not differentiable."""
    points = vertices.detach()
    return nearest_point(points, points @ mirror)


def best_confidence(distance2: Tensor, cost: float) -> Tensor:
    """The sigma in (0, 1] that minimises sigma d^2 + lambda_B ln(1 / sigma): min(1, lambda_B / d^2).

    Equation 9 of the paper, of which the network's head only approaches the minimum.

    With lambda_B = 0.0005 a vertex counts as symmetric up to 2 % of the object's size. (V,) -> (V,)
    """
    return (cost / distance2.clamp_min(cost)).detach()


def surface_confidence(mesh: Mesh, plane: MirrorPlane, scale: float, cost: float) -> Tensor:
    """Symmetry confidence (V,) by the distance d of each mirrored vertex to the surface, in units of `scale`.

    1 / (1 + (d^2 / (3 lambda_B))^2): falls with every step away, where `best_confidence` is 1 up to
    sqrt(lambda_B), which tells small from nothing; half at 3.9 % of the size with lambda_B = 0.0005.
    To the surface and not to its vertices: a symmetric object need not have symmetric triangles.
    """
    vertices, n = mesh.vertices.double().cpu(), plane.normal.double().cpu()
    surface = torch.cat([vertices[mesh.faces.cpu().unique()], surface_points(mesh, DENSE_SAMPLES)])
    mirrored = vertices - 2 * (vertices @ n - plane.offset)[:, None] * n
    distance = torch.from_numpy(cKDTree(surface.numpy()).query(mirrored.numpy())[0]) / scale
    return 1 / (1 + (distance.square().to(mesh.vertices) / (3 * cost)).square())


def mirror_error(mesh: Mesh, normal: Tensor) -> Callable[[float], float]:
    """A function of the offset d: mean distance of the surface mirrored in the plane n.x = d to the surface.

    World units, over surface points that are the same for the same mesh.
    """
    points = surface_points(mesh, SAMPLES).double().cpu()
    n = normal.double().cpu()
    tree, height = cKDTree(points.numpy()), points @ n

    def error(offset: float) -> float:
        mirrored = points - 2 * (height - offset)[:, None] * n
        return float(tree.query(mirrored.numpy())[0].mean())

    return error


def least_mirrored_offset(mesh: Mesh, normal: Tensor) -> float:
    """Offset d of the plane n.x = d for which the mirrored coarse mesh is nearest to itself, world units.

    A grid of offsets over the middle half of the mesh, refined around its best value six times.
    """
    error = mirror_error(mesh, normal)
    height = mesh.vertices[mesh.faces.unique()] @ normal
    low, high = float(height.min()), float(height.max())
    centre, span = (low + high) / 2, (high - low) / 4
    for _ in range(7):
        centre = min((centre + span * k / 4 for k in range(-4, 5)), key=error)
        span /= 3
    return centre


def surface_points(mesh: Mesh, samples: int) -> Tensor:
    """`samples` points spread over the surface by area, the same for the same mesh: (samples, 3) float64."""
    a, b, c = mesh.vertices.double().cpu()[mesh.faces.cpu()].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    steps = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples * area.sum()
    face = torch.searchsorted(area.cumsum(0), steps).clamp_max(len(area) - 1)
    # low-discrepancy position inside the face (R2 sequence), folded into the triangle
    k = torch.arange(1, samples + 1, dtype=torch.float64)
    u, v = (k * 0.7548776662466927) % 1, (k * 0.5698402909980532) % 1
    outside = u + v > 1
    u, v = torch.where(outside, 1 - u, u), torch.where(outside, 1 - v, v)
    return a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
