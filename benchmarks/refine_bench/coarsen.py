"""A coarse mesh as a single-view reconstruction network would predict it, made from ground truth.

Networks of the occupancy kind see the object on a coarse grid: details blur, thin parts swell or vanish,
nearby parts fuse. Seen from one image, proportions and depth are guesses, and a part that the image shows
badly comes out too short or is missing. `coarsen` does these and ends with a mesh of about 1,500 vertices.
For an object of a class that it never saw, a network gives the mean of what it knows: `mistake`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import fast_simplification
import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]
MARGIN_CELLS = 4  # empty cells around the object, so that the blurred surface stays closed
THIN_GAIN = (
    3.0  # a cell counts as full from a third of coverage: networks swell thin parts rather than drop them
)
FINE_EDGE_CELLS = 0.7  # triangles before the decimation
RAY = np.array([0.4871, 0.5143])  # in a column: off its middle, to miss vertices and edges of regular shapes
COLUMNS_PER_CELL = 2  # rays per cell and axis: coverage instead of a yes or no


@dataclass(frozen=True)
class Coarsening:
    """How bad the reconstruction is. Lengths are fractions of the object's longest side."""

    cells: int = 40
    """Grid cells along the longest side."""
    blur_cells: float = 0.75
    """Standard deviation of the Gaussian blur, in cells."""
    occupancy_level: float = 0.3
    """Occupancy of the surface. Below one half, as networks are tuned, the object comes out fat."""
    shortening: float = 0.25
    """Largest share that the outer part on one side loses of its length."""
    stretch: float = 0.06
    """Standard deviation of the logarithm of the scale per axis."""
    shift: float = 0.015
    """Standard deviation of the displacement of the whole object per axis."""
    bend: float = 0.012
    """Standard deviation of a smooth displacement that differs from place to place."""
    lost_radius: float = 0.0
    """A ball of this radius, centred on the outer surface, is missing: a lost part."""
    triangles: int = 3000
    """Triangles of the result: the size at which the method was published."""


MILD = Coarsening(cells=56, shortening=0.0, stretch=0.02, shift=0.005, bend=0.005)
STRONG = Coarsening()


def coarsen(shape: trimesh.Trimesh, seed: int, config: Coarsening = STRONG) -> trimesh.Trimesh:
    """The coarse version that `seed` names of a watertight `shape`, in the frame of `shape`."""
    return _predict([shape], seed, config)


def mistake(
    shape: trimesh.Trimesh, known: Sequence[trimesh.Trimesh], seed: int, config: Coarsening = STRONG
) -> trimesh.Trimesh:
    """`shape` predicted out of class: the mean of watertight `known` shapes, each stretched into its box."""
    low, high = shape.bounds
    stretched = []
    for other in known:
        start, end = other.bounds
        moved = (other.vertices - start) / (end - start) * (high - low) + low
        stretched.append(trimesh.Trimesh(moved, other.faces, process=False))
    return _predict(stretched, seed, config)


def _predict(shapes: Sequence[trimesh.Trimesh], seed: int, config: Coarsening) -> trimesh.Trimesh:
    """One mesh from the mean occupancy of shapes that share a box, with the errors that `seed` names."""
    rng = np.random.default_rng(seed)
    low, high = shapes[0].bounds
    cell = float((high - low).max()) / config.cells
    origin = low - MARGIN_CELLS * cell
    size = np.ceil((high - low) / cell).astype(int) + 2 * MARGIN_CELLS
    filled = np.mean([np.minimum(THIN_GAIN * occupancy(s, origin, cell, size), 1.0) for s in shapes], 0)
    if config.lost_radius > 0.0:
        filled *= _kept(shapes[0], seed, origin, cell, config)
    density = gaussian_filter(filled, config.blur_cells)
    vertices, faces = _surface(density, config.occupancy_level, config.triangles)
    return trimesh.Trimesh(distort(vertices * cell + origin, rng, config), faces, process=False)


def _kept(shape: trimesh.Trimesh, seed: int, origin: Array, cell: float, config: Coarsening) -> Array:
    """1 in the cells that are not lost, broadcast as (X, Y, Z): all but a ball about one of the vertices that
    are far from the middle, where networks lose legs, tips and handles."""
    rng = np.random.default_rng([seed, 1])  # its own stream: the other errors stay those of the seed
    centre, radius = shape.bounds.mean(0), config.lost_radius * float(shape.extents.max())
    distance = np.linalg.norm(shape.vertices - centre, axis=1)
    outer = shape.vertices[distance > 0.8 * distance.max()]
    middle = outer[rng.integers(len(outer))]
    cells = np.ceil(shape.extents / cell).astype(int) + 2 * MARGIN_CELLS
    axes = [origin[k] + (np.arange(cells[k]) + 0.5) * cell - middle[k] for k in range(3)]
    squared = sum(np.square(d) for d in np.meshgrid(*axes, indexing="ij", sparse=True))
    return np.asarray(squared > radius**2, dtype=np.float64)


def occupancy(shape: trimesh.Trimesh, origin: Array, cell: float, size: NDArray[np.int64]) -> Array:
    """Share of each cell inside a watertight shape, (X, Y, Z): exact along z, sampled by rays in x and y.

    Entering and leaving triangles have normals of opposite sign along the ray, so the length inside a cell is
    the signed sum of the clamped depths; no sorting and no parity.
    """
    rays = size[:2] * COLUMNS_PER_CELL
    spacing = cell / COLUMNS_PER_CELL
    depth_sum = np.zeros((rays[0], rays[1], size[2]))
    edges = np.arange(size[2])
    triangles = (shape.vertices[shape.faces] - origin) / [spacing, spacing, cell]
    for a, b, c in triangles:
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        corners = np.stack([a, b, c])[:, :2]
        first = np.ceil(corners.min(0) - RAY).astype(int)
        last = np.floor(corners.max(0) - RAY).astype(int)
        x, y = np.meshgrid(*(np.arange(s, t + 1) for s, t in zip(first, last, strict=True)), indexing="ij")
        px, py = x + RAY[0], y + RAY[1]
        u = ((b[0] - px) * (c[1] - py) - (b[1] - py) * (c[0] - px)) / area
        v = ((c[0] - px) * (a[1] - py) - (c[1] - py) * (a[0] - px)) / area
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        z = (u * a[2] + v * b[2] + (1 - u - v) * c[2])[hit]
        depth_sum[x[hit], y[hit]] += np.sign(area) * np.clip(z[:, None] - edges, 0.0, 1.0)
    blocks = depth_sum.reshape(size[0], COLUMNS_PER_CELL, size[1], COLUMNS_PER_CELL, size[2])
    share: Array = np.clip(blocks.mean((1, 3)), 0.0, 1.0)
    return share


def _surface(density: Array, level: float, triangles: int) -> tuple[Array, NDArray[np.int64]]:
    """Vertices in cells and faces of the level set of cell-centred densities, decimated to `triangles`."""
    bounds = [0.0, 0.0, 0.0, *(float(n) for n in density.shape)]
    fine = _without_crumbs(Manifold.level_set(_trilinear(density), bounds, FINE_EDGE_CELLS, level)).to_mesh()
    vertices, faces = fast_simplification.simplify(
        np.array(fine.vert_properties[:, :3], dtype=np.float64, order="C"),
        np.array(fine.tri_verts, dtype=np.int32, order="C"),
        target_count=triangles,
    )
    return vertices, faces.astype(np.int64)


def _without_crumbs(solid: Manifold) -> Manifold:
    """The solid less the pieces that hold below 1 % of its volume, which networks' users drop too."""
    kept = [piece for piece in solid.decompose() if piece.volume() > 0.01 * solid.volume()]
    return Manifold.compose(kept)


def _trilinear(density: Array) -> Callable[[float, float, float], float]:
    """Interpolate between cell centres; plain floats, because manifold3d asks for one point at a time."""
    values, (nx, ny, nz) = density.tolist(), density.shape

    def field(x: float, y: float, z: float) -> float:
        x, y, z = (min(max(c - 0.5, 0.0), n - 1.001) for c, n in ((x, nx), (y, ny), (z, nz)))
        i, j, k = int(x), int(y), int(z)
        u, v, w = x - i, y - j, z - k
        near, far = values[i], values[i + 1]
        rows = (near[j], near[j + 1], far[j], far[j + 1])
        a, b, c, d = (row[k] + w * (row[k + 1] - row[k]) for row in rows)
        low, high = a + v * (b - a), c + v * (d - c)
        return float(low + u * (high - low))

    return field


def distort(vertices: Array, rng: Generator, config: Coarsening) -> Array:
    """Shorten one side, bend, and get the proportions and the place wrong."""
    longest = float(np.ptp(vertices, 0).max())
    points = _shorten(vertices, rng, config.shortening)
    waves, phases = rng.normal(size=(4, 3)) * (np.pi / longest), rng.uniform(0, 2 * np.pi, 4)
    directions = rng.normal(size=(4, 3)) * (config.bend * longest / np.sqrt(2))
    points = points + np.sin(points @ waves.T + phases) @ directions
    centre = (points.min(0) + points.max(0)) / 2
    scale = np.exp(rng.normal(size=3) * config.stretch)
    moved: Array = (points - centre) * scale + centre + rng.normal(size=3) * config.shift * longest
    return moved


def _shorten(points: Array, rng: Generator, largest: float) -> Array:
    """Compress what lies beyond a cut across x or y, on a random side of it, towards the cut."""
    axis, side = int(rng.integers(2)), rng.choice([-1.0, 1.0])
    share = rng.uniform(0.5, 1.0) * largest
    along = side * points[:, axis]
    cut = along.min() + rng.uniform(0.5, 0.65) * np.ptp(along)
    result = points.copy()
    result[:, axis] = side * np.where(along > cut, cut + (1 - share) * (along - cut), along)
    return result
