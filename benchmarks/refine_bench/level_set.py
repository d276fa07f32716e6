"""Marching cubes, and decimation to the size of mesh at which the method was published."""

from __future__ import annotations

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
PUBLISHED_TRIANGLES = 3000


def level_set(field: Array, level: float, triangles: int | None = PUBLISHED_TRIANGLES) -> tuple[Array, Faces]:
    """The surface around values above `level` of a grid (X, Y, Z): vertices in indices, faces outward.

    All pieces are kept; more than `triangles` are decimated, None keeps them all.
    """
    vertices, faces, _, _ = marching_cubes(field, level, gradient_direction="ascent")
    return decimated(vertices.astype(np.float64), faces.astype(np.int64), triangles)


def decimated(
    vertices: Array, faces: Faces, triangles: int | None = PUBLISHED_TRIANGLES
) -> tuple[Array, Faces]:
    """At most about `triangles` of them."""
    if triangles is None or len(faces) <= triangles:
        return vertices, faces
    fewer, simple = fast_simplification.simplify(
        np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int32), target_count=triangles
    )
    return fewer, simple.astype(np.int64)
