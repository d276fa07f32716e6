"""Tangents that follow a surface whose vertices were moved, so that a normal map keeps its directions."""

from __future__ import annotations

import numpy as np

from .weld import Floats, Ints, unit


def carried_tangents(tangents: Floats, before: Floats, after: Floats, faces: Ints, normals: Floats) -> Floats:
    """Tangents (N, 4) of positions moved from `before` to `after` (N, 3), for their new unit normals (N, 3).

    Each triangle of `faces` (F, 3) carries the tangents of its corners along as if drawn on it; a vertex has
    the mean by area, made a unit vector across its normal. The handedness stays, and so does the tangent of a
    vertex that no triangle uses.
    """
    directions = unit(np.nan_to_num(tangents[:, :3]), fallback=np.array([1.0, 0.0, 0.0]))
    edges, moved = (_edges(points, faces) for points in (before, after))
    gram = edges @ edges.swapaxes(1, 2)
    area = np.sqrt(np.maximum(np.linalg.det(gram), 0.0))
    flat = area <= 1e-12 * gram.trace(axis1=1, axis2=2)  # no plane to draw in
    inverse = np.linalg.inv(np.where(flat[:, None, None], np.eye(2), gram))
    total = np.zeros_like(directions)
    for corner in range(3):
        vertex = faces[:, corner]
        drawn = inverse @ edges @ directions[vertex, :, None]  # (F, 2, 1) along the two edges
        along = (moved.swapaxes(1, 2) @ drawn)[..., 0] * np.where(flat, 0.0, area)[:, None]
        for axis in range(3):
            total[:, axis] += np.bincount(vertex, along[:, axis], len(total))
    total = unit(total, fallback=directions)
    across = unit(total - (total * normals).sum(1, keepdims=True) * normals, fallback=_any_across(normals))
    used = np.bincount(faces.ravel(), minlength=len(tangents)) > 0
    sides = np.where(tangents[:, 3:] < 0, -1.0, 1.0)
    return np.where(used[:, None], np.concatenate([across, sides], 1), tangents)


def _edges(points: Floats, faces: Ints) -> Floats:
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return np.stack([b - a, c - a], 1)


def _any_across(normals: Floats) -> Floats:
    """A unit vector (N, 3) perpendicular to each normal."""
    axis = np.eye(3)[np.abs(normals).argmin(1)]
    return unit(np.cross(normals, axis), fallback=np.array([1.0, 0.0, 0.0]))
