"""A mesh of many vertices made small: clusters in the cells of a fine grid, then edge collapse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .collapse import Floats, Ints, collapse, connected_within

CLUSTERS = 30_000  # vertices, about, that the grid leaves to collapse
MOST = 2  # times the wanted number of vertices, where a mesh has so many pieces that they cannot be fewer


@dataclass(frozen=True)
class Decimated:
    """What is left of a mesh of V vertices."""

    vertices: Floats  # (N, 3)
    faces: Ints  # (M, 3)
    vertex_of: Ints  # (V,) the vertex that each vertex of the mesh became


def decimate(vertices: Floats, faces: Ints, count: int) -> Decimated:
    """About `count` of vertices (V, 3), all used by faces (F, 3); up to MOST times as many if it would fold.

    A piece keeps its topology, down to a triangle. Of very many pieces only the largest are kept.
    """
    points, faces, vertex_of = _clustered(vertices, faces)
    corners = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    key = np.unique(corners[:, 0] * len(points) + corners[:, 1])
    edges = np.stack([key // len(points), key % len(points)], 1)
    parent = collapse(points, faces, quadrics(points, faces), edges, count)
    points, faces, label = _compact(points, faces, parent)
    if len(points) > MOST * count:
        points, faces, stands_for = _largest_pieces(points, faces, MOST * count)
        label = stands_for[label]
    return Decimated(points, faces, label[vertex_of])


def quadrics(vertices: Floats, faces: Ints) -> Floats:
    """(V, 4, 4): of the squared distances to the planes of a vertex's faces, weighted by their areas.

    An open edge adds the plane through it across its face, so that borders stay where they are.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    twice_area = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(twice_area, 1e-300)[:, None]
    total = np.zeros((len(vertices), 16))
    _add_planes(total, faces, normal, a, twice_area / 6)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key = edges.min(1) * len(vertices) + edges.max(1)
    _, first, uses = np.unique(key, return_index=True, return_counts=True)
    single = first[uses == 1]
    start, end = (vertices[edges[single, k]] for k in range(2))
    across = np.cross(end - start, normal[single // 3])
    length = np.linalg.norm(across, axis=1)
    _add_planes(total, edges[single], across / np.maximum(length, 1e-300)[:, None], start, length**2)
    return total.reshape(-1, 4, 4)


def _add_planes(total: Floats, corners: Ints, normal: Floats, point: Floats, weight: Floats) -> None:
    plane = np.concatenate([normal, -(normal * point).sum(1, keepdims=True)], 1)
    product = (weight[:, None, None] * plane[:, :, None] * plane[:, None, :]).reshape(-1, 16)
    for corner in corners.T:
        for entry in range(16):
            total[:, entry] += np.bincount(corner, product[:, entry], len(total))


def _clustered(vertices: Floats, faces: Ints) -> tuple[Floats, Ints, Ints]:
    """About CLUSTERS vertices: those that a cell holds and that are connected within it become their mean."""
    if len(vertices) <= CLUSTERS:
        return vertices.copy(), faces.copy(), np.arange(len(vertices))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    cell = max((area / CLUSTERS) ** 0.5, 1e-6 * float(np.ptp(vertices, 0).max()))
    place = ((vertices - vertices.min(0)) / cell).astype(np.int64)
    key = (place[:, 0] << 42) | (place[:, 1] << 21) | place[:, 2]
    root = connected_within(key, faces)
    size = np.bincount(root, minlength=len(root))
    mean = np.stack([np.bincount(root, x, len(root)) for x in vertices.T], 1) / np.maximum(size, 1)[:, None]
    return _compact(mean, root[faces], root)


def _largest_pieces(points: Floats, faces: Ints, most: int) -> tuple[Floats, Ints, Ints]:
    """The pieces with the largest area that have `most` points together, and which point stands for each."""
    count = len(points)
    links = coo_array(
        (np.ones(len(faces) * 2, bool), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), (count, count)
    )
    pieces, piece = connected_components(links, directed=False)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.bincount(piece[faces[:, 0]], np.linalg.norm(np.cross(b - a, c - a), axis=1), pieces)
    order = np.argsort(-area, kind="stable")
    size = np.cumsum(np.bincount(piece, minlength=pieces)[order])
    large = np.zeros(pieces, bool)
    large[order[: max(1, int(np.searchsorted(size, most, "right")))]] = True
    kept = np.flatnonzero(large[piece])
    parent = kept[cKDTree(points[kept]).query(points)[1]]
    parent[kept] = kept  # of points at one place too
    return _compact(points, faces[large[piece[faces[:, 0]]]], parent)


def _compact(points: Floats, faces: Ints, parent: Ints) -> tuple[Floats, Ints, Ints]:
    """The points that are their own parents, the distinct faces between them, and every point's number.

    A face is left out where two corners are one; of faces with the same corners, however wound, one is left.
    """
    kept = parent == np.arange(len(parent))
    label = (np.cumsum(kept) - 1)[parent]
    faces = label[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    low, middle, high = np.sort(faces, axis=1).T
    count = int(kept.sum())
    key = (low * count + middle) * count + high
    return points[kept], faces[np.unique(key, return_index=True)[1]], label
