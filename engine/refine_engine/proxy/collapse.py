"""The loops over single vertices in decimation: union-find of clusters, and edge collapse in order of cost.

Collapse by quadric error (Garland and Heckbert 1997) with a share of edge length, so that flat parts keep
triangles that can bend.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from ..kernels.jit import numba_jit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LENGTH_SHARE = 0.01  # of the squared edge length in the cost, beside the squared distance to the planes
STIFFNESS = 1e-3  # of the pull to the middle of the edge, where the planes leave the place open
FLIPPED = 0.2  # cosine between a face's normals before and after: below it an edge is not collapsed

jit = numba_jit(error_model="numpy")


@jit
def connected_within(key: Ints, faces: Ints) -> Ints:
    """For each vertex the first one that edges between vertices of one key (V,) connect it with."""
    root = np.arange(len(key))
    for face in faces:
        for k in range(3):
            a, b = face[k], face[(k + 1) % 3]
            if key[a] != key[b]:
                continue
            while root[a] != a:
                root[a] = root[root[a]]
                a = root[a]
            while root[b] != b:
                root[b] = root[root[b]]
                b = root[b]
            if a < b:
                root[b] = a
            else:
                root[a] = b
    for v in range(len(root)):  # a root is never after what it is the root of
        root[v] = root[root[v]]
    return root


@jit
def collapse(points: Floats, faces: Ints, quadrics: Floats, edges: Ints, count: int) -> Ints:
    """Collapse edges (E, 2), the cheapest first, until `count` vertices are left: which vertex each became.

    Works on points (V, 3), faces (F, 3) and quadrics (V, 4, 4) in place; faces that lose a corner repeat one.
    A collapse that would fold or pinch the surface is not done, so that more vertices may be left.
    """
    total = len(points)
    corner_of = np.full(total, -1, np.int64)  # the first of a vertex's corners, each of which knows the next
    following = np.full(3 * len(faces), -1, np.int64)
    for corner in range(3 * len(faces)):
        v = faces[corner // 3, corner % 3]
        following[corner], corner_of[v] = corner_of[v], corner
    parent, changes, seen = np.arange(total), np.zeros(total, np.int64), np.full(total, -1, np.int64)
    heap = [(0.0, np.int64(0), np.int64(0), np.int64(-1))]
    for edge in edges:
        heap.append((_placed(points, quadrics, edge[0], edge[1])[3], edge[0], edge[1], np.int64(0)))
    heapq.heapify(heap)
    left, look = total, 0
    while left > count and len(heap) > 0:
        _, a, b, at = heapq.heappop(heap)
        if parent[a] != a or parent[b] != b or changes[a] + changes[b] != at:
            continue
        x, y, z, _ = _placed(points, quadrics, a, b)
        if _folds(points, faces, corner_of, following, a, b, x, y, z):
            continue
        look += 2
        if _pinches(faces, corner_of, following, a, b, seen, look):
            continue
        points[a, 0], points[a, 1], points[a, 2] = x, y, z
        quadrics[a] += quadrics[b]
        _join(faces, corner_of, following, a, b)
        parent[b] = a
        changes[a] += 1
        left -= 1
        look += 2
        corner = corner_of[a]
        while corner >= 0:
            for k in range(1, 3):
                n = faces[corner // 3, (corner + k) % 3]
                if seen[n] != look and n != a:
                    seen[n] = look
                    cost = _placed(points, quadrics, a, n)[3]
                    heapq.heappush(heap, (cost, a, n, changes[a] + changes[n]))
            corner = following[corner]
    for v in range(total):
        w = v
        while parent[w] != w:
            w = parent[w]
        parent[v] = w
    return parent


@jit
def _placed(points: Floats, quadrics: Floats, a: int, b: int) -> tuple[float, float, float, float]:
    """Where the vertex goes that replaces an edge, and what that costs."""
    q = quadrics[a] + quadrics[b]
    area = q[0, 0] + q[1, 1] + q[2, 2]  # of unit normals: the sum of the weights of the planes
    hold = STIFFNESS * area + 1e-300
    middle = 0.5 * (points[a] + points[b])
    xx, yy, zz = q[0, 0] + hold, q[1, 1] + hold, q[2, 2] + hold
    xy, xz, yz = q[0, 1], q[0, 2], q[1, 2]
    u, v, w = hold * middle[0] - q[0, 3], hold * middle[1] - q[1, 3], hold * middle[2] - q[2, 3]
    cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * cx + xy * cy + xz * cz
    x, y, z = middle
    if abs(determinant) > 1e-12 * hold * hold * area:
        x = (u * cx + v * cy + w * cz) / determinant
        y = (u * cy + v * (xx * zz - xz * xz) + w * (xy * xz - xx * yz)) / determinant
        z = (u * cz + v * (xy * xz - xx * yz) + w * (xx * yy - xy * xy)) / determinant
    error = (
        x * (q[0, 0] * x + 2 * (xy * y + xz * z + q[0, 3]))
        + y * (q[1, 1] * y + 2 * (yz * z + q[1, 3]))
        + z * (q[2, 2] * z + 2 * q[2, 3])
        + q[3, 3]
    )
    length2 = ((points[a] - points[b]) ** 2).sum()
    return x, y, z, max(error, 0.0) + LENGTH_SHARE * area * length2


@jit
def _folds(
    points: Floats,
    faces: Ints,
    corner_of: Ints,
    following: Ints,
    a: int,
    b: int,
    x: float,
    y: float,
    z: float,
) -> bool:
    """Whether a face of one of the two vertices, but not of both, turns around when they go to x, y, z."""
    new = np.array([x, y, z])
    for end in (a, b):
        other = b if end == a else a
        corner = corner_of[end]
        while corner >= 0:
            face = faces[corner // 3]
            p, q = face[(corner + 1) % 3], face[(corner + 2) % 3]
            if p != other and q != other and p != q and p != end and q != end:
                before = np.cross(points[p] - points[end], points[q] - points[end])
                after = np.cross(points[p] - new, points[q] - new)
                sizes = np.sqrt((before**2).sum() * (after**2).sum())
                if (before * after).sum() < FLIPPED * sizes:
                    return True
            corner = following[corner]
    return False


@jit
def _pinches(faces: Ints, corner_of: Ints, following: Ints, a: int, b: int, seen: Ints, look: int) -> bool:
    """Whether a vertex would lose its last face, or the surface would touch itself: the two vertices have a
    common neighbour that no face of both has (the link condition)."""
    corner, unshared = corner_of[a], 0
    while corner >= 0:
        if _proper(faces[corner // 3]):
            unshared += 1
            for k in range(1, 3):
                seen[faces[corner // 3, (corner + k) % 3]] = look
        corner = following[corner]
    corner, common, shared = corner_of[b], 0, 0
    while corner >= 0:
        face = faces[corner // 3]
        if _proper(face):
            of_both = face[0] == a or face[1] == a or face[2] == a
            shared += of_both
            unshared += -1 if of_both else 1
            for k in range(1, 3):
                n = face[(corner + k) % 3]
                if n != a and seen[n] == look:
                    seen[n] = look + 1
                    common += 1
                    if of_both and _is_last(faces, corner_of, following, n):
                        return True
        corner = following[corner]
    return common != shared or unshared == 0


@jit
def _is_last(faces: Ints, corner_of: Ints, following: Ints, v: int) -> bool:
    """Whether the vertex has one face only."""
    corner, count = corner_of[v], 0
    while corner >= 0 and count < 2:
        count += _proper(faces[corner // 3])
        corner = following[corner]
    return count < 2


@jit
def _proper(face: Ints) -> bool:
    return bool(face[0] != face[1] and face[1] != face[2] and face[2] != face[0])


@jit
def _join(faces: Ints, corner_of: Ints, following: Ints, a: int, b: int) -> None:
    """Give the corners of b to a, and leave out those of faces that had both."""
    corner, kept = corner_of[b], np.int64(-1)
    for end in (b, a):
        corner = corner_of[end]
        while corner >= 0:
            then = following[corner]
            face = faces[corner // 3]
            face[corner % 3] = a
            if _proper(face):
                following[corner] = kept
                kept = corner
            corner = then
    corner_of[a] = kept
