"""Surfaces of many vertices."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from refine_engine.proxy.collapse import Floats, Ints


def grid(rows: int, columns: int) -> tuple[Floats, Ints]:
    """A flat square of so many vertices, each side of length 1."""
    y, x = np.mgrid[0 : 1 : rows * 1j, 0 : 1 : columns * 1j]
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (number[i : rows - 1 + i, j : columns - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(rows * columns)], 1), faces


def tube(radius: float, rows: int, around: int) -> tuple[Floats, Ints]:
    """A closed tube of length 1 along X: a grid whose sides are sewn together, with a tip at each end."""
    flat, faces = grid(rows, around + 1)
    angle = 2 * np.pi * flat[:, 0]
    vertices = np.stack([flat[:, 1], radius * np.cos(angle), radius * np.sin(angle)], 1)
    row, column = np.divmod(np.arange(len(vertices)), around + 1)
    faces = (row * around + column % around)[faces]
    vertices = vertices[column < around]
    ring = np.arange(around)
    start, end = len(vertices), len(vertices) + 1
    last = (rows - 1) * around
    caps = [
        np.stack([np.full(around, start), (ring + 1) % around, ring], 1),
        np.stack([np.full(around, end), last + ring, last + (ring + 1) % around], 1),
    ]
    return np.concatenate([vertices, [[0, 0, 0], [1, 0, 0]]]), np.concatenate([faces, *caps])


def sphere(count: int) -> tuple[Floats, Ints]:
    z = 1 - (np.arange(count) + 0.5) * 2 / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = points[faces].swapaxes(0, 1)
    inwards = (np.cross(b - a, c - a) * a).sum(1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return points / 2, faces
