"""Coarse meshes with the errors of the other families of single-view networks, made from ground truth.

atlas    AtlasNet: 25 open patches that overlap, bulge and do not meet
voxels   Mesh R-CNN: the faces of filled voxels, smoothed, with bits of staircase left
field    DISN, DeepSDF: marching cubes of a noisy distance field, with floaters

They have the shape of each family's output, not its accuracy: how far a network puts the object wrong is a
matter of its training, and here the same mild distortion for all.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping

import numpy as np
import trimesh
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from refine_engine.scores.scores import sample_surface

from .coarsen import Coarsening, distort, occupancy
from .level_set import Array, Faces, decimated, level_set

DISTORTION = Coarsening(shortening=0.0, stretch=0.03, shift=0.01, bend=0.015)

PATCHES, PATCH_SIDE = 25, 8  # AtlasNet's number; vertices along a patch's side: 1,600 vertices in all
PATCH_POINTS = 20_000  # of the surface, shared among the patches
OVERLAP = 1.5  # points of a patch, as a multiple of its share
VOXELS, FULL = 28, 0.3  # along the longest side; share of a voxel from which it is filled
VOXEL_DOUBT = 0.1  # standard deviation of a voxel's share
SMOOTHING_STEPS, SMOOTHING = 3, 0.5
FIELD_CELLS, FIELD_MARGIN = 56, 6  # along the longest side; empty cells around
FIELD_NOISE, NOISE_CELLS = 0.012, 3.0  # standard deviation, of the longest side; smoothness, in cells
FLOATERS, FLOATER_RADIUS = (2, 5), (0.012, 0.03)  # how many, and how large, of the longest side


def predict(family: str, shape: trimesh.Trimesh, seed: int) -> trimesh.Trimesh:
    """A watertight `shape` as a network of the family would predict it; the seed names the errors."""
    rng = np.random.default_rng([seed, zlib.crc32(family.encode())])
    vertices, faces = FAMILIES[family](shape, rng)
    return trimesh.Trimesh(distort(vertices, rng, DISTORTION), faces, process=False)


def atlas(shape: trimesh.Trimesh, rng: Generator) -> tuple[Array, Faces]:
    """Each patch is a square grid laid over its points along their main directions, and drawn to them."""
    points = sample_surface(np.asarray(shape.triangles), PATCH_POINTS, rng)
    tree = cKDTree(points)
    count = int(OVERLAP * PATCH_POINTS / PATCHES)
    steps = np.linspace(0.0, 1.0, PATCH_SIDE)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
    cell = np.arange(PATCH_SIDE**2).reshape(PATCH_SIDE, PATCH_SIDE)
    a, b, c, d = (corner.ravel() for corner in (cell[:-1, :-1], cell[1:, :-1], cell[1:, 1:], cell[:-1, 1:]))
    square = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices, faces = [], []
    for number, middle in enumerate(_spread(points, PATCHES, rng)):
        own = points[tree.query(middle, count)[1]]
        centre = own.mean(0)
        axes = np.linalg.svd(own - centre, full_matrices=False)[2][:2]
        flat = (own - centre) @ axes.T
        low, high = np.quantile(flat, [0.02, 0.98], axis=0)
        spots = low + grid * (high - low)
        distance, nearest = cKDTree(flat).query(spots, 24)  # enough to smooth what lies above each other
        weight = np.exp(-0.5 * (distance / distance.mean(1, keepdims=True)) ** 2)
        vertices.append((weight[..., None] * own[nearest]).sum(1) / weight.sum(1, keepdims=True))
        faces.append(square + number * len(grid))
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int64)


def _spread(points: Array, count: int, rng: Generator) -> Array:
    """(count, 3): points far from each other, the farthest one next."""
    chosen = [points[int(rng.integers(len(points)))]]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, np.linalg.norm(points - chosen[-1], axis=1))
        chosen.append(points[int(distance.argmax())])
    return np.array(chosen)


def voxels(shape: trimesh.Trimesh, rng: Generator) -> tuple[Array, Faces]:
    """Filled where a voxel is covered enough, with some voxels wrong near the surface; then smoothed."""
    share, origin, cell = _grid(shape, VOXELS, 2)
    doubt = VOXEL_DOUBT * rng.normal(size=share.shape)
    filled = (share + doubt > FULL) & (gaussian_filter(share, 1.0) > 0.02)  # wrong near the surface only
    corners, faces = cubify(filled)
    return decimated(smoothed(origin + cell * corners, faces, SMOOTHING_STEPS), faces)


def cubify(filled: NDArray[np.bool_]) -> tuple[Array, Faces]:
    """The faces between filled and empty cells (X, Y, Z), outward, with shared corners. Cells that touch
    along an edge share its vertices: the mesh is not manifold there, nor is Mesh R-CNN's."""
    padded = np.pad(filled, 1)
    quads = []
    for axis in range(3):
        for side in (1, -1):
            open_side = padded & ~np.roll(padded, -side, axis)
            cells = np.argwhere(open_side) - 1
            u, v = (axis + 1) % 3, (axis + 2) % 3
            offsets = np.zeros((4, 3), np.int64)
            offsets[:, axis] = side > 0
            offsets[[1, 2], u], offsets[[2, 3], v] = 1, 1
            quads.append(cells[:, None] + (offsets if side > 0 else offsets[::-1]))
    places = np.concatenate(quads)  # (Q, 4, 3)
    corners, index = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    square = index.reshape(-1, 4)
    return corners.astype(np.float64), np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])


def smoothed(vertices: Array, faces: Faces, steps: int) -> Array:
    """Each vertex moved towards the mean of its neighbours."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(sides, 1), axis=0)
    ends = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(ends[:, 0], minlength=len(vertices))[:, None]
    for _ in range(steps):
        total = np.zeros_like(vertices)
        np.add.at(total, ends[:, 0], vertices[ends[:, 1]])
        vertices = (1 - SMOOTHING) * vertices + SMOOTHING * total / degree
    return vertices


def field(shape: trimesh.Trimesh, rng: Generator) -> tuple[Array, Faces]:
    """The zero level of a distance field on a grid, wrong by smooth noise, with small balls in the air."""
    share, origin, cell = _grid(shape, FIELD_CELLS, FIELD_MARGIN)
    inside = gaussian_filter(share, 0.5) > 0.4
    distance = distance_transform_edt(~inside) - distance_transform_edt(inside)  # cells, positive outside
    noise = gaussian_filter(rng.normal(size=share.shape), NOISE_CELLS)
    distance += noise / noise.std() * FIELD_NOISE * FIELD_CELLS
    places = np.stack(np.meshgrid(*(np.arange(n) for n in share.shape), indexing="ij"), -1)
    for _ in range(int(rng.integers(FLOATERS[0], FLOATERS[1] + 1))):
        near = np.argwhere((distance > 2) & (distance < 8))
        middle = near[int(rng.integers(len(near)))]
        radius = rng.uniform(*FLOATER_RADIUS) * FIELD_CELLS
        distance = np.minimum(distance, np.linalg.norm(places - middle, axis=-1) - radius)
    vertices, faces = level_set(gaussian_filter(-distance, 0.6), 0.0)
    return origin + cell * (vertices + 0.5), faces


def _grid(shape: trimesh.Trimesh, cells: int, margin: int) -> tuple[Array, Array, float]:
    """Share of each cell inside the shape (X, Y, Z), the corner of the first cell, the length of a cell."""
    low, high = shape.bounds
    cell = float((high - low).max()) / cells
    size = np.ceil((high - low) / cell).astype(int) + 2 * margin
    origin = low - margin * cell
    return occupancy(shape, origin, cell, size), origin, cell


FAMILIES: Mapping[str, Callable[[trimesh.Trimesh, Generator], tuple[Array, Faces]]] = {
    "atlas": atlas,
    "voxels": voxels,
    "field": field,
}
