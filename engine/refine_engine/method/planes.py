"""The mirror plane of an object, found on its coarse mesh in any direction.

Nobody tells a service where the mirror plane is, and a mesh in the frame of its camera has it anywhere. A
plane is as good as the surface mirrored in it is near to the surface. The search looks at normals all over
the half sphere, improves the best few by matching each mirrored point with its nearest one (the iterated
closest points of Besl and McKay 1992, for a reflection), and prefers a world axis that is as good as any:
networks that predict in the object's frame have the plane there exactly, and their mesh is only nearly
symmetric.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..values import Mesh, MirrorPlane
from .config import RefineConfig
from .symmetry import least_mirrored_offset, mirror_error, surface_points

Array = NDArray[np.float64]

DIRECTIONS = 300  # normals tried over the half sphere: 10 degrees apart
QUERIES = 400  # mirrored points for each of them
POINTS = 1600  # of the surface that they are compared with
STARTS = 6  # of these, so many are improved, at least 20 degrees apart
STEPS = 12  # of improvement
FAR = 0.2  # longest sides: a mirrored point farther from the surface than this counts no more
NEAR = 0.01  # longest sides: the distance at which a match begins to lose weight
AXIS_TOLERANCE = 1.15  # how much worse than the best plane one across a world axis may be
NO_SYMMETRY = 0.06  # longest sides: a surface whose mirror image is farther away has no mirror plane
WORLD_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # the paper's first


def mirror_plane(mesh: Mesh, config: RefineConfig) -> MirrorPlane | None:
    """The plane that the config gives or asks to find; None: the object is taken to have none."""
    if config.symmetry == "none":
        return None
    if config.symmetry == "auto":
        return find_mirror_plane(mesh)
    normal = torch.nn.functional.normalize(mesh.vertices.new_tensor(config.symmetry_normal), dim=0)
    if config.symmetry_offset is not None:
        return MirrorPlane(normal, config.symmetry_offset, None)
    offset = least_mirrored_offset(mesh, normal)
    return MirrorPlane(normal, offset, mirror_error(mesh, normal)(offset) / longest_side(mesh))


def find_mirror_plane(mesh: Mesh) -> MirrorPlane | None:
    """The plane in which the mirrored surface is nearest to itself; None if it is far from itself in all."""
    side = longest_side(mesh)
    points = surface_points(mesh, POINTS).numpy() / side
    surface = cKDTree(points)
    queries = points[:: POINTS // QUERIES]
    found = [
        _improved(normal, points.mean(0), queries, surface) for normal in _starts(points, queries, surface)
    ]
    errors = [_error(normal, offset, points, surface) for normal, offset in found]
    best = int(np.argmin(errors))
    normal, offset, error = (*found[best], errors[best])
    for axis in WORLD_AXES:
        across = mesh.vertices.new_tensor(axis)
        at = least_mirrored_offset(mesh, across) / side
        axis_error = _error(np.array(axis), at, points, surface)
        if axis_error <= AXIS_TOLERANCE * error:
            normal, offset, error = np.array(axis), at, axis_error
            break
    if error > NO_SYMMETRY:
        return None
    return MirrorPlane(mesh.vertices.new_tensor(normal), offset * side, error)


def longest_side(mesh: Mesh) -> float:
    """Of the bounding box of the vertices that faces use, world units."""
    used = mesh.vertices[mesh.faces.unique()]
    return float((used.amax(0) - used.amin(0)).max())


def _starts(points: Array, queries: Array, surface: cKDTree) -> Array:
    """The best of the directions with planes through the centroid: (STARTS, 3)."""
    z = 1 - (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    angle = np.pi * (1 + 5**0.5) * (np.arange(DIRECTIONS) + 0.5)  # Fibonacci's lattice
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
    centre = points.mean(0)
    height = directions @ (queries - centre).T  # (D, Q)
    mirrored = queries - 2 * height[:, :, None] * directions[:, None]
    distance = surface.query(mirrored.reshape(-1, 3), distance_upper_bound=FAR)[0]
    error = np.minimum(distance, FAR).reshape(len(directions), -1).mean(1)
    chosen: list[int] = []
    for i in np.argsort(error, kind="stable"):
        if all(abs(directions[i] @ directions[j]) < np.cos(np.radians(20)) for j in chosen):
            chosen.append(int(i))
        if len(chosen) == STARTS:
            break
    return np.asarray(directions[chosen])


def _improved(normal: Array, centre: Array, queries: Array, surface: cKDTree) -> tuple[Array, float]:
    """A plane after some steps: match the mirrored points, then the plane that mirrors the pairs best.

    Of pairs (q, u) with weights w, the normal that makes sum w |T q - u|^2 least is the eigenvector of the
    least eigenvalue of the symmetric part of sum w (q - mean q)(u - mean u)^T, and the plane goes through the
    middle of the two means.
    """
    offset = float(centre @ normal)
    for _ in range(STEPS):
        distance, nearest = surface.query(queries - 2 * ((queries @ normal) - offset)[:, None] * normal)
        partner = surface.data[nearest]
        weight = 1 / (distance + NEAR)
        weight /= weight.sum()
        mean, partner_mean = weight @ queries, weight @ partner
        moment = ((queries - mean) * weight[:, None]).T @ (partner - partner_mean)
        direction = np.linalg.eigh(moment + moment.T)[1][:, 0]
        turned = direction if direction @ normal > 0 else -direction
        settled = turned @ normal > 1 - 1e-8
        normal, offset = turned, float((mean + partner_mean) / 2 @ turned)
        if settled:
            break
    return normal, offset


def _error(normal: Array, offset: float, points: Array, surface: cKDTree) -> float:
    mirrored = points - 2 * ((points @ normal) - offset)[:, None] * normal
    return float(surface.query(mirrored)[0].mean())
