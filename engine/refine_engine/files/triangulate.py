"""Polygons -> triangles: convex ones as fans, the others by clipping ears in the plane of the polygon."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import MeshInvalid
from ..kernels.jit import numba_jit
from .weld import Floats, Ints

_MAX_CONCAVE = 500  # corners: clipping ears may cost the cube of them


def triangulate(points: Floats, sizes: Ints) -> tuple[Ints, Ints]:
    """Cut polygons; `points` (C, 3) are their corners one polygon after another, `sizes` (P,) how many each.

    Returns triangles (T, 3) of corner numbers, in the order of the polygons, and the polygon (T,) of each.
    Every corner stays a corner of a triangle. Polygons of less than 3 corners give none. Raises MeshInvalid.
    """
    starts = np.cumsum(sizes) - sizes
    triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for size in np.unique(sizes[sizes >= 3]):
        polygon = np.flatnonzero(sizes == size)
        corners = starts[polygon, None] + np.arange(size)
        fan = np.stack([np.zeros(size - 2, np.int64), np.arange(1, size - 1), np.arange(2, size)], 1)
        cut = np.broadcast_to(fan, (len(polygon), size - 2, 3)).copy()
        if size > 3:
            flat = _in_their_planes(points[corners])
            concave = np.flatnonzero(_turns_back(flat))
            if len(concave) and size > _MAX_CONCAVE:
                raise MeshInvalid(
                    f"expected polygons of at most {_MAX_CONCAVE} corners unless convex, got {size}; "
                    "triangulate the mesh first"
                )
            for number in concave:
                cut[number] = _clip_ears(flat[number])
        triangles.append((starts[polygon, None, None] + cut).reshape(-1, 3))
        owners.append(np.repeat(polygon, size - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _in_their_planes(points: Floats) -> Floats:
    """Polygons (P, N, 3) in the planes of their mean normals: (P, N, 2), counter-clockwise."""
    centred = points - points.mean(1, keepdims=True)
    size = np.abs(centred).max((1, 2), keepdims=True)
    centred = centred / np.where(size > 0, size, 1.0)
    normal = np.cross(centred, np.roll(centred, -1, 1)).sum(1)
    axis = np.abs(normal).argmin(1)
    u = np.cross(normal, np.eye(3)[axis])
    v = np.cross(normal, u)
    length = np.linalg.norm(u, axis=1, keepdims=True), np.linalg.norm(v, axis=1, keepdims=True)
    u, v = (w / np.where(n > 0, n, 1.0) for w, n in zip((u, v), length, strict=True))
    flat: Floats = np.stack([(centred * u[:, None]).sum(2), (centred * v[:, None]).sum(2)], 2)
    return flat


def _turns_back(flat: Floats) -> NDArray[np.bool_]:
    """Which polygons (P, N, 2) turn clockwise somewhere, or go round more than once."""
    ahead = np.roll(flat, -1, 1) - flat
    behind = np.roll(ahead, 1, 1)
    turn = behind[..., 0] * ahead[..., 1] - behind[..., 1] * ahead[..., 0]
    angle = np.arctan2(turn, (behind * ahead).sum(2))
    back: NDArray[np.bool_] = (turn < -1e-9).any(1) | (angle.sum(1) > 3 * np.pi)
    return back


@numba_jit()
def _clip_ears(flat: Floats) -> Ints:
    """Triangles (N - 2, 3) of the polygon (N, 2).

    An ear is a corner whose triangle holds no other corner, at best not even on its border. Where there is
    none (the polygon crosses itself, or corners lie on a line) the corner of the smallest triangle goes.
    """
    count = len(flat)
    left = np.arange(count)
    triangles = np.empty((count - 2, 3), np.int64)
    for done in range(count - 2):
        chosen = _ear(flat, left, -1e-14)
        if chosen < 0:
            chosen = _ear(flat, left, 1e-12)
        if chosen < 0:
            flattest = np.inf
            for i in range(len(left)):
                area = abs(_cross(flat[left[i - 1]], flat[left[i]], flat[left[(i + 1) % len(left)]]))
                if area < flattest:
                    chosen, flattest = i, area
        triangles[done, 0] = left[chosen - 1]
        triangles[done, 1] = left[chosen]
        triangles[done, 2] = left[(chosen + 1) % len(left)]
        left = np.delete(left, chosen)
    return triangles


@numba_jit()
def _ear(flat: Floats, left: Ints, inset: float) -> int:
    """The first convex corner whose triangle has no other corner deeper inside than `inset`; -1: none."""
    for i in range(len(left)):
        a, b, c = flat[left[i - 1]], flat[left[i]], flat[left[(i + 1) % len(left)]]
        if _cross(a, b, c) <= 1e-14:
            continue
        free = True
        for j in range(len(left)):
            p = flat[left[j]]
            if (p == a).all() or (p == b).all() or (p == c).all():
                continue
            if _cross(a, b, p) > inset and _cross(b, c, p) > inset and _cross(c, a, p) > inset:
                free = False
                break
        if free:
            return i
    return -1


@numba_jit()
def _cross(a: Floats, b: Floats, c: Floats) -> float:
    """Twice the area of a triangle, positive if it is counter-clockwise."""
    doubled: float = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return doubled
