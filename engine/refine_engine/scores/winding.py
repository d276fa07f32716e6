"""Generalised winding numbers: how much of the view from a point a mesh covers, signed by its orientation.

One inside a closed mesh, zero outside, and something between near the holes of an open one, so "above one
half" is a robust inside test (Jacobson, Kavan, Sorkine-Hornung 2013, doi:10.1145/2461912.2461916). Triangles
far from the point are taken together as one dipole, as in the fast winding number (Barill et al. 2018,
doi:10.1145/3197517.3201337), here with one level of clusters instead of a tree. Written here and not taken
from libigl: its wheel carries binaries of CGAL and TetGen, whose licences are copyleft.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..kernels.jit import numba_jit

Array = NDArray[np.float64]
CLUSTER_TRIANGLES = 8
FAR_RADII = 2.0  # a cluster farther away than this many of its radii is a dipole


def winding_numbers(triangles: Array, points: Array) -> Array:
    """The winding number of a mesh about each point.

    Args:
        triangles: (F, 3, 3) corner positions, counter-clockwise seen from outside.
        points: (P, 3), same units.

    Returns:
        (P,), within about 0.05 of the exact solid angle sum divided by 4 pi.
    """
    clusters = _clusters(triangles.mean(1))
    order = np.concatenate(clusters)
    bounds = np.cumsum([0, *map(len, clusters)])
    sorted_triangles = np.ascontiguousarray(triangles[order], dtype=np.float64)
    a, b, c = sorted_triangles.transpose(1, 0, 2)
    area_normals = np.cross(b - a, c - a) / 2
    areas = np.linalg.norm(area_normals, axis=1)
    weights = np.maximum(areas, 1e-12 * areas.max(initial=1e-300))[:, None]
    totals = np.add.reduceat(weights, bounds[:-1])
    centres = np.add.reduceat(weights * sorted_triangles.mean(1), bounds[:-1]) / totals
    owner = np.repeat(np.arange(len(clusters)), np.diff(bounds))
    reach = np.linalg.norm(sorted_triangles - centres[owner, None], axis=2).max(1)
    radii = np.maximum.reduceat(reach, bounds[:-1])
    dipoles = np.add.reduceat(area_normals, bounds[:-1])
    queries = np.ascontiguousarray(points, dtype=np.float64)
    result = np.empty(len(queries))
    _sum_solid_angles(sorted_triangles, bounds, centres, radii, dipoles, queries, result)
    return result


def _clusters(centres: Array) -> list[NDArray[np.int64]]:
    """Indices of nearby triangles: halved at the median of the longest side until small enough."""
    pending, done = [np.arange(len(centres))], []
    while pending:
        group = pending.pop()
        if len(group) <= CLUSTER_TRIANGLES:
            done.append(group)
            continue
        axis = int(np.ptp(centres[group], 0).argmax())
        half = len(group) // 2
        group = group[np.argpartition(centres[group, axis], half)]
        pending += [group[:half], group[half:]]
    return done


@numba_jit()
def _sum_solid_angles(
    triangles: Array,  # (F, 3, 3), clusters one after another
    bounds: NDArray[np.int64],  # (C + 1,) first triangle of each cluster
    centres: Array,  # (C, 3) centroids, weighted by area
    radii: Array,  # (C,) reach of the cluster from its centre
    dipoles: Array,  # (C, 3) sum of area * normal
    points: Array,  # (P, 3)
    result: Array,  # (P,) written
) -> None:
    for i in range(len(points)):
        px, py, pz = points[i]
        total = 0.0
        for k in range(len(radii)):
            dx, dy, dz = centres[k, 0] - px, centres[k, 1] - py, centres[k, 2] - pz
            square = dx * dx + dy * dy + dz * dz
            far = FAR_RADII * radii[k]
            if square > far * far:
                total += (dipoles[k, 0] * dx + dipoles[k, 1] * dy + dipoles[k, 2] * dz) / (
                    square * math.sqrt(square)
                )
                continue
            for t in range(bounds[k], bounds[k + 1]):
                total += _solid_angle(triangles[t], px, py, pz)
        result[i] = total / (4.0 * math.pi)


@numba_jit()
def _solid_angle(triangle: Array, px: float, py: float, pz: float) -> float:
    """Signed solid angle of a triangle seen from p (Van Oosterom and Strackee 1983), in (-2 pi, 2 pi]."""
    ax, ay, az = triangle[0, 0] - px, triangle[0, 1] - py, triangle[0, 2] - pz
    bx, by, bz = triangle[1, 0] - px, triangle[1, 1] - py, triangle[1, 2] - pz
    cx, cy, cz = triangle[2, 0] - px, triangle[2, 1] - py, triangle[2, 2] - pz
    a = math.sqrt(ax * ax + ay * ay + az * az)
    b = math.sqrt(bx * bx + by * by + bz * bz)
    c = math.sqrt(cx * cx + cy * cy + cz * cz)
    volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
    return 2.0 * math.atan2(volume, a * b * c + ab * c + bc * a + ca * b)
