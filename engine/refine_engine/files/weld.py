"""Joining the copies of a vertex that file formats keep, and normals that respect what was joined.

A file stores one vertex per (position, texture coordinate, normal); moving the copies separately would tear
the surface along every seam. What is joined, and what is kept apart:

- Copies at exactly one position are one vertex if at least one of them lies on an open border of the file's
  own triangles: that is what a seam is. Where every copy closes its own fan of triangles, these are separate
  surfaces that only touch, and they stay apart, unless their triangles coincide too (a sheet stored once per
  side).
- The two ends of an edge of length zero are one vertex.
- Border vertices that are left and are closer than 1e-5 of the bounding box diagonal (and a tenth of the
  median edge) are one vertex. Interior vertices never are: two sheets of a double shell, however close, stay
  apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_TOLERANCE = 1e-5  # of the bounding box diagonal
_SAME_NORMAL = 0.1  # distance of unit normals: copies below it are one smooth surface, above it a hard edge


@dataclass(frozen=True)
class Weld:
    """S source vertices joined to V. Vertices are in the order of their first copy in the file."""

    vertex_of: Ints  # (S,) the vertex of each source vertex, -1 if no triangle uses it
    source_of: Ints  # (V,) the first copy, whose position the vertex has
    faces: Ints  # (F, 3) without triangles that joining made degenerate


def weld(positions: Floats, faces: Ints) -> Weld:
    """Join the copies in positions (S, 3) as used by faces (F, 3)."""
    count = len(positions)
    faces = faces[_proper(faces)]
    exact = _components(_exact_links(positions, faces), count)
    joined = exact[faces]
    joined = joined[_proper(joined)]
    first = _first_of(exact)
    near = _components(_near_links(positions[first], joined), len(first))
    joined = near[joined]
    joined = joined[_proper(joined)]
    label = near[exact]
    used = _used(joined, len(first))
    source_of = _first_of(label)[used]
    order = np.argsort(source_of)
    vertex = np.full(int(label.max(initial=-1)) + 1, -1, np.int64)
    vertex[used[order]] = np.arange(len(used))
    return Weld(vertex[label], source_of[order], vertex[joined])


def _exact_links(positions: Floats, faces: Ints) -> Ints:
    place = _row_ids(positions)
    first = _first_of(place)
    used = _used(faces, len(positions))
    seam = np.zeros(len(first), bool)
    seam[place[used[border(faces, len(positions))[used]]]] = True
    copies = used[seam[place[used]]]
    # Links go to the place's first copy in use: one that no triangle uses does not take part.
    anchor = np.full(len(first), len(positions), np.int64)
    np.minimum.at(anchor, place[used], used)
    edges = _edges(faces)
    zero = edges[place[edges[:, 0]] == place[edges[:, 1]]]
    return np.concatenate([np.stack([copies, anchor[place[copies]]], 1), zero, _coincident(place, faces)])


def _coincident(place: Ints, faces: Ints) -> Ints:
    """Links (N, 2) between the corners of triangles that lie on the same three places."""
    order = np.argsort(place[faces], axis=1)
    corners = np.take_along_axis(faces, order, axis=1)
    same = _row_ids(place[corners])
    return np.stack([corners.ravel(), corners[_first_of(same)[same]].ravel()], 1)


def _near_links(positions: Floats, faces: Ints) -> Ints:
    none = np.empty((0, 2), np.int64)
    open_ends = np.flatnonzero(border(faces, len(positions)))
    if len(open_ends) < 2:
        return none
    edges = _edges(faces)
    lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    used = positions[_used(faces, len(positions))]
    diagonal = float(np.linalg.norm(used.max(0) - used.min(0)))
    reach = min(_TOLERANCE * diagonal, 0.1 * float(np.median(lengths)))
    neighbours = min(5, len(open_ends))  # itself and four more: bounded whatever the file holds
    distance, other = cKDTree(positions[open_ends]).query(
        positions[open_ends], k=neighbours, distance_upper_bound=reach
    )
    row, column = np.nonzero(np.isfinite(distance))
    links = np.stack([open_ends[row], open_ends[other[row, column]]], 1)
    # A group that holds both ends of an edge would swallow a triangle: such a group stays as it was.
    group = _components(links, len(positions))
    swallows = np.zeros(int(group.max()) + 1, bool)
    inner = edges[group[edges[:, 0]] == group[edges[:, 1]]]
    swallows[group[inner[:, 0]]] = True
    kept: Ints = links[~swallows[group[links[:, 0]]]]
    return kept


def border(faces: Ints, count: int) -> NDArray[np.bool_]:
    """Which of `count` vertices lie on an edge that only one triangle has; a doubled triangle counts once."""
    distinct = np.sort(faces, axis=1)
    distinct = distinct[_first_of(_row_ids(distinct))]
    edges = np.sort(_edges(distinct), axis=1)
    keys, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    single = keys[uses == 1]
    marked = np.zeros(count, bool)
    marked[single // max(count, 1)] = True
    marked[single % max(count, 1)] = True
    return marked


def smooth_groups(vertex_of: Ints, normals: Floats) -> Ints:
    """Group (S,): copies of one vertex whose normals (S, 3) agree share a normal; across a hard edge they
    differ."""
    order = np.lexsort((normals[:, 2], normals[:, 1], normals[:, 0], vertex_of))
    links = []
    for step in range(
        1, 9
    ):  # equal normals are neighbours in this order; rounding may put a few others between
        a, b = order[:-step], order[step:]
        same = (vertex_of[a] == vertex_of[b]) & (vertex_of[a] >= 0)
        a, b = a[same], b[same]
        agree = np.linalg.norm(normals[a] - normals[b], axis=1) < _SAME_NORMAL
        links.append(np.stack([a[agree], b[agree]], 1))
    return _components(np.concatenate(links), len(vertex_of))


def vertex_normals(before: Floats, after: Floats, faces: Ints, group: Ints, normals: Floats) -> Floats:
    """Unit normals (S, 3) of the positions `after`, area-weighted over the triangles of each smooth group.

    A triangle counts with the side that the file's `normals` (S, 3) showed on the positions `before`, so that
    a badly wound mesh keeps its shading. Where nothing is left to average, the file's normal stays.
    """
    old, new = _area_vectors(before, faces), _area_vectors(after, faces)
    total = np.zeros((int(group.max(initial=-1)) + 1, 3))
    for corner in range(3):
        vertex = faces[:, corner]
        side = np.where((old * normals[vertex]).sum(1) < 0.0, -1.0, 1.0)
        for axis in range(3):
            total[:, axis] += np.bincount(group[vertex], side * new[:, axis], len(total))
    return unit(total[group], fallback=unit(normals, fallback=np.array([0.0, 1.0, 0.0])))


def unit(vectors: Floats, fallback: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    good = (length > 1e-30) & np.isfinite(length)
    return np.where(good, vectors / np.where(good, length, 1.0), fallback)


def _area_vectors(positions: Floats, faces: Ints) -> Floats:
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _proper(faces: Ints) -> NDArray[np.bool_]:
    a, b, c = faces.T
    proper: NDArray[np.bool_] = (a != b) & (b != c) & (c != a)
    return proper


def _edges(faces: Ints) -> Ints:
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _used(faces: Ints, count: int) -> Ints:
    """Which of `count` vertices the faces use, ascending."""
    marked = np.zeros(count, bool)
    marked[faces] = True
    return np.flatnonzero(marked)


def _row_ids(rows: NDArray[Any]) -> Ints:
    """A number per row; equal rows have equal numbers."""
    if len(rows) == 0:
        return np.empty(0, np.int64)
    order = np.lexsort(rows.T)
    ordered = rows[order]
    ids = np.empty(len(rows), np.int64)
    ids[order] = np.cumsum(np.r_[0, (ordered[1:] != ordered[:-1]).any(1)])
    return ids


def _first_of(ids: Ints) -> Ints:
    """The first position at which each of the ids 0 ... N-1 occurs."""
    return np.unique(ids, return_index=True)[1].astype(np.int64)


def _components(links: Ints, count: int) -> Ints:
    """The connected component (count,) of each of `count` things under links (N, 2)."""
    graph = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(count, count))
    labels: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels
