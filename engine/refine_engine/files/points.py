"""Point clouds as surfaces, by Poisson reconstruction: the indicator function of the solid is the one whose
gradient is the field of the points' normals, found with Fourier transforms on a grid.

Sources: Kazhdan, Bolitho, Hoppe, Poisson Surface Reconstruction, 2006; the solution by Fourier transforms:
Kazhdan, Reconstruction of Solid Models from Oriented Point Sets, 2005. Normals that are not given are those
of planes through the nearest points, turned to one side along a minimum spanning tree: Hoppe et al., Surface
Reconstruction from Unorganized Points, 1992.
"""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from ..errors import MeshInvalid
from .isosurface import border_mean, isosurface
from .limits import MeshLimits
from .surface import Part, Polygons
from .weld import Floats, Ints, unit

_FEWEST, _MOST = 50, 200_000  # points; of more an even share is taken
_NEIGHBOURS = 12  # of a point, among which a plane is found
_GRID = (32, 96)  # cells on the longest side of the points' box, at least and at most
_MARGIN = 0.25  # of the longest side, so that the surface does not meet its copy at the border
_SMOOTH = 1.0  # cells: how far a point's normal reaches


def reconstruct(points: Floats, attributes: Part, limits: MeshLimits) -> Polygons:
    """A closed surface through points (N, 3); `attributes` by their glTF names, of which NORMAL is used and
    COLOR_0 kept. Raises MeshInvalid."""
    finite = np.flatnonzero(np.isfinite(points).all(1))
    places = finite[
        np.unique(points[finite], axis=0, return_index=True)[1]
    ]  # copies would slow the tree down
    if len(places) < _FEWEST:
        raise MeshInvalid(f"expected triangles, or at least {_FEWEST} points, got {len(places)} points")
    chosen = places[:: -(-len(places) // _MOST)]
    used, tree = points[chosen], cKDTree(points[chosen])
    size = float(np.ptp(used, axis=0).max())
    if not 0 < size < 1e30:
        raise MeshInvalid("expected points that span a volume, got one place or coordinates beyond 1e30")
    distance, neighbours = tree.query(used, k=min(_NEIGHBOURS, len(used)))
    given = attributes.get("NORMAL")
    if given is not None and np.isfinite(given[chosen]).all() and given[chosen].any(1).all():
        normals, told = unit(given[chosen].astype(np.float64), np.zeros(3)), "their own normals"
    else:
        normals, told = oriented_normals(used, neighbours), "normals estimated from their neighbours"
    polygons = _surface(used, normals, float(np.median(distance[:, 1:5])), size, limits)
    count = len(polygons.positions)
    if "COLOR_0" in attributes:
        polygons.of_vertex["COLOR_0"] = attributes["COLOR_0"][chosen][tree.query(polygons.positions)[1]]
    polygons.warnings = (
        f"a mesh of {count} vertices was made from {len(used)} of {len(points)} points with {told}: "
        "look at it",
    )
    return polygons


def oriented_normals(points: Floats, neighbours: Ints) -> Floats:
    """Unit normals (N, 3) of the planes through each point's `neighbours` (N, K), which all show outwards."""
    around = points[neighbours] - points[neighbours].mean(1, keepdims=True)
    normals = np.linalg.eigh(around.swapaxes(1, 2) @ around)[1][:, :, 0]
    count, width = neighbours.shape
    row, column = np.repeat(np.arange(count), width - 1), neighbours[:, 1:].ravel()
    # An edge between points whose normals agree costs little, so that signs travel along the surface.
    cost = 1.0 + 1e-6 - np.abs((normals[row] * normals[column]).sum(1))
    graph = coo_array((cost, (row, column)), shape=(count, count)).tocsr()
    spanning = minimum_spanning_tree(graph.maximum(graph.T)).tocoo()
    piece_of = connected_components(spanning, directed=False)[1]
    rising = np.lexsort((points[:, 1], piece_of))
    tops = rising[np.r_[piece_of[rising][1:] != piece_of[rising][:-1], True]]  # of each piece the highest
    root = count  # a node above all pieces, so that one walk reaches every point
    links = np.concatenate([spanning.row, np.full(len(tops), root)]), np.concatenate([spanning.col, tops])
    forest = coo_array((np.ones(len(links[0])), links), shape=(count + 1, count + 1)).tocsr()
    order, parent = breadth_first_order(forest, root, directed=False)
    upwards = np.append(normals, [[0.0, 1.0, 0.0]], axis=0)  # at the top of a piece up is outwards
    turns = ((upwards[order[1:]] * upwards[parent[order[1:]]]).sum(1) < 0).tolist()
    turned = [False] * (count + 1)
    for point, before, turn in zip(order[1:].tolist(), parent[order[1:]].tolist(), turns, strict=True):
        turned[point] = turned[before] != turn
    normals[np.array(turned[:count])] *= -1
    return normals


def _surface(points: Floats, normals: Floats, spacing: float, size: float, limits: MeshLimits) -> Polygons:
    cells = int(np.clip(size / max(spacing, 1e-9 * size), *_GRID))
    step = size / cells
    margin = int(np.ceil(_MARGIN * cells))
    shape = tuple(int(np.ceil(side / step)) + 2 * margin for side in np.ptp(points, axis=0))
    origin = points.min(0) - margin * step
    at = (points - origin) / step
    inside = _indicator(at, normals, shape)
    level = float(np.mean(map_coordinates(inside, at.T, order=1)))
    if border_mean(inside) > level:  # all normals show inwards
        inside, level = -inside, -level
    outside = min(float(inside.min()), level - 1.0)
    return isosurface(inside, level, outside, origin, np.full(3, step), limits)


def _indicator(at: Floats, normals: Floats, shape: tuple[int, ...]) -> Floats:
    """Values on the grid that rise towards the inside: the inward normals at points `at` (N, 3), in cells,
    are spread over the grid, smoothed, and integrated."""
    field = np.stack([_spread(at, -normals[:, axis], shape) for axis in range(3)])
    turns = [fft.fftfreq(shape[0]), fft.fftfreq(shape[1]), fft.rfftfreq(shape[2])]
    waves = np.meshgrid(*(2 * np.pi * axis for axis in turns), indexing="ij", sparse=True)
    squared = sum(wave**2 for wave in waves)
    divergence = sum(1j * wave * fft.rfftn(part) for wave, part in zip(waves, field, strict=True))
    with np.errstate(all="ignore"):
        solution = np.where(squared > 0, -divergence / squared, 0) * np.exp(-0.5 * _SMOOTH**2 * squared)
    values: Floats = fft.irfftn(solution, shape)
    return values


def _spread(at: Floats, amounts: Floats, shape: tuple[int, ...]) -> Floats:
    """Each amount on the eight cells around its place, by nearness."""
    low = np.floor(at).astype(np.int64)
    near = at - low
    total = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, near, 1 - near), axis=1)
        place = np.ravel_multi_index(tuple((low + corner).T), shape)
        total += np.bincount(place, amounts * share, len(total))
    return total.reshape(shape)
