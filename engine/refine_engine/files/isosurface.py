"""Values on a grid -> the polygons of the surface where they pass a level (marching cubes)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MeshInvalid
from .limits import MeshLimits
from .surface import Polygons
from .weld import Floats

MAX_CELLS = 2**24  # of a grid: 256 a side; marching cubes needs a hundred bytes for each


def check_cells(shape: tuple[int, ...]) -> None:
    """Refuse a grid by what its header announces."""
    if len(shape) != 3 or min(shape) < 1:
        raise MeshInvalid(f"expected a grid of three dimensions, got {shape!s:.60}")
    if np.prod([float(side) for side in shape]) > MAX_CELLS:
        raise MeshInvalid(
            f"expected at most {MAX_CELLS} cells (256 a side), got {shape!s:.60}; make it coarser"
        )


def border_mean(values: NDArray[Any]) -> float:
    """The mean over the six outer layers of a grid (X, Y, Z)."""
    layers = [np.take(values, [0, -1], axis).ravel() for axis in range(3)]
    return float(np.concatenate(layers).mean(dtype=np.float64))


def isosurface(
    values: NDArray[Any], level: float, outside: float, origin: Floats, step: Floats, limits: MeshLimits
) -> Polygons:
    """The surface around what is above `level` in `values` (X, Y, Z), of which everything beyond the grid is
    `outside`. Cell (0, 0, 0) has its centre at `origin` (3,), the next ones lie `step` (3,) apart.

    Raises MeshInvalid if there is none, or if it is larger than `limits`.
    """
    from skimage.measure import marching_cubes  # here: few files need it, and it takes long to import

    grid = np.pad(values.astype(np.float32), 1, constant_values=outside)
    above = grid > level
    # One vertex on each edge of the grid that the surface crosses, twice as many triangles.
    crossings = sum(int(np.count_nonzero(np.diff(above, axis=axis))) for axis in range(3))
    if not crossings:
        raise MeshInvalid(f"expected a grid with an inside and an outside, got none above {level:g} or all")
    limits.check_source(crossings, 2 * crossings - 4)
    vertices, faces, _, _ = marching_cubes(grid, level, gradient_direction="ascent")
    positions = origin + (vertices.astype(np.float64) - 1) * step
    sizes = np.full(len(faces), 3)
    return Polygons(positions, faces.astype(np.int64).ravel(), sizes, {}, {})
