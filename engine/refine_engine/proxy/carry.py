"""The displacement of a few vertices, carried smoothly to the many that they stand for.

Every vertex of the proxy predicts the displacement around it by an affine map, and a vertex of the full mesh
takes the mean of the predictions of those around the one that it became, weighted by a smooth function of
the distance that is zero beyond a radius (the embedded deformation of Sumner et al. 2007). So nothing steps
where one vertex of the proxy gives way to the next, and a displacement that is affine arrives as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ..kernels.jit import numba_jit
from .collapse import Floats, Ints
from .decimate import Decimated

REACH = 1.25  # radius of a vertex's weight, in its longest edges: every point of its triangles is within it
RINGS = 3  # of neighbours whose predictions count, if they reach
MOST = 48  # of them, the nearest
STIFFNESS = 0.05  # of the predicted gradient, where the neighbours do not determine it
CORRECTIONS = 2  # of what the means smooth away; more of them make waves
SAMPLES = 6  # a face is looked at in SAMPLES * (SAMPLES + 1) / 2 points
LEAST = 1e-6  # weight of the vertex that another one became: nothing else may reach it

jit = numba_jit(error_model="numpy")


@dataclass(frozen=True)
class Carrier:
    """Carries what is known of the N vertices of a proxy to the V of its mesh."""

    proxy: Decimated
    points: Floats  # (V, 3) of the mesh, before it was displaced
    near: Ints  # (N, MOST) whose predictions may count around a vertex of the proxy; -1: none
    radius: Floats  # (N,)

    @staticmethod
    def of(proxy: Decimated, points: Floats) -> Carrier:
        """For a mesh with `points` (V, 3) that became `proxy`."""
        edges = _edges(proxy.faces)
        position = proxy.vertices
        length = np.linalg.norm(position[edges[:, 0]] - position[edges[:, 1]], axis=1)
        radius = np.zeros(len(position))
        np.maximum.at(radius, edges.ravel(), np.repeat(length, 2))
        return Carrier(proxy, points, _around(position, edges), REACH * radius)

    def displacement(self, moved: Floats) -> Floats:
        """(V, 3): of the mesh, where the vertices of the proxy moved by `moved` (N, 3)."""
        centre = self.proxy.vertices.mean(0)
        local = np.c_[self.proxy.vertices - centre, np.ones(len(moved))]
        affine = np.linalg.lstsq(local, moved, rcond=1e-6)[0]
        rest = moved - local @ affine
        told, own = rest, np.arange(len(rest))
        for _ in range(CORRECTIONS):  # a mean is less than what it is of: ask for more
            told = told + rest - self._predicted(told, self.proxy.vertices, own)
        carried = self._predicted(told, self.points, self.proxy.vertex_of)
        moved_along: Floats = carried + (self.points - centre) @ affine[:3] + affine[3]
        return moved_along

    def _predicted(self, values: Floats, points: Floats, vertex_of: Ints) -> Floats:
        """(P, 3): of `points` (P, 3) by values (N, 3) and their gradients."""
        position = self.proxy.vertices
        gradient = _gradients(position, values, _edges(self.proxy.faces))
        constant = values - np.einsum("nij,nj->ni", gradient, position)
        field = np.concatenate([gradient, constant[:, :, None]], 2)
        predicted: Floats = _blend(points, vertex_of, self.near, position, self.radius, field)
        return predicted

    def kept(self, kept: NDArray[np.bool_], faces: Ints) -> NDArray[np.bool_]:
        """(F,): which `faces` of the mesh are kept: as the nearest ones of the proxy are, by `kept` (M,)."""
        proxy = self.proxy
        around = np.zeros(len(proxy.vertices), bool)
        around[proxy.faces[~kept]] = True
        for _ in range(2):
            around[proxy.faces[around[proxy.faces].any(1)]] = True
        asked = np.flatnonzero(around[proxy.vertex_of[faces]].any(1))
        nearby = np.flatnonzero(around[proxy.faces].any(1))
        samples = np.einsum("sc,fcd->fsd", _spread(SAMPLES), proxy.vertices[proxy.faces[nearby]])
        centres = self.points[faces[asked]].mean(1)
        nearest = cKDTree(samples.reshape(-1, 3)).query(centres)[1] // samples.shape[1]
        of_mesh = np.ones(len(faces), bool)
        of_mesh[asked] = kept[nearby[nearest]]
        return of_mesh

    def values(self, values: Floats) -> Floats:
        """(V,): of the mesh, where the vertices of the proxy have `values` (N,)."""
        field = np.zeros((len(values), 1, 4))
        field[:, 0, 3] = values
        args = self.points, self.proxy.vertex_of, self.near, self.proxy.vertices, self.radius, field
        blended: Floats = _blend(*args)[:, 0]
        return blended


def _spread(count: int) -> Floats:
    """(S, 3): barycentric coordinates of points spread evenly over a triangle."""
    pairs = [(i, j) for i in range(count) for j in range(count - i)]
    return np.array([[count - i - j - 2 / 3, i + 1 / 3, j + 1 / 3] for i, j in pairs]) / count


def _edges(faces: Ints) -> Ints:
    corners = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(corners, axis=0)


def _around(position: Floats, edges: Ints) -> Ints:
    """(N, MOST) the vertices within RINGS edges, the nearest first; -1: there are no more."""
    count = len(position)
    both = np.concatenate([edges, edges[:, ::-1]])
    step = csr_array((np.ones(len(both), np.float32), both.T), shape=(count, count))
    step.setdiag(1)
    reached = step
    for _ in range(RINGS - 1):
        reached = reached @ step
        reached.data[:] = 1
    row, column = reached.nonzero()
    order = np.lexsort([np.linalg.norm(position[row] - position[column], axis=1), row])
    row, column = row[order], column[order]
    rank = np.arange(len(row)) - np.searchsorted(row, row)
    near = np.full((count, MOST), -1, np.int64)
    near[row[rank < MOST], rank[rank < MOST]] = column[rank < MOST]
    return near


def _gradients(position: Floats, values: Floats, edges: Ints) -> Floats:
    """(N, 3, 3) d value / d position of values (N, 3), least squares over a vertex's edges."""
    both = np.concatenate([edges, edges[:, ::-1]])
    step = position[both[:, 1]] - position[both[:, 0]]
    change = values[both[:, 1]] - values[both[:, 0]]
    moments, products = (np.zeros((len(position), 3, 3)) for _ in range(2))
    np.add.at(moments, both[:, 0], step[:, :, None] * step[:, None, :])
    np.add.at(products, both[:, 0], change[:, :, None] * step[:, None, :])
    hold = STIFFNESS * np.trace(moments, axis1=1, axis2=2) + 1e-300
    return np.linalg.solve(moments + hold[:, None, None] * np.eye(3), products.swapaxes(1, 2)).swapaxes(1, 2)


@jit
def _blend(
    points: Floats, vertex_of: Ints, near: Ints, position: Floats, radius: Floats, field: Floats
) -> Floats:
    """(V, C) weighted means of the predictions field (N, C, 4) @ (x, y, z, 1) at points (V, 3)."""
    channels = field.shape[1]
    blended = np.zeros((len(points), channels))
    total = np.zeros((channels, 4))
    for v in range(len(points)):
        x, y, z = points[v]
        own = vertex_of[v]
        total[:] = LEAST * field[own]
        weights = LEAST
        for n in near[own]:
            if n < 0:
                break
            dx, dy, dz = x - position[n, 0], y - position[n, 1], z - position[n, 2]
            inside = 1.0 - (dx * dx + dy * dy + dz * dz) / (radius[n] * radius[n])
            if inside > 0.0:
                weight = inside * inside
                weights += weight
                for c in range(channels):
                    for k in range(4):
                        total[c, k] += weight * field[n, c, k]
        for c in range(channels):
            blended[v, c] = (total[c, 0] * x + total[c, 1] * y + total[c, 2] * z + total[c, 3]) / weights
    return blended
