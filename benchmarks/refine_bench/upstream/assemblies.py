"""Objects of no category: a few boxes, rods and ellipsoids grown together, to learn from what seeing is.

From twelve categories alone a network learns to tell them apart, and answers anything else with one of them.
"""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold
from numpy.random import Generator
from numpy.typing import NDArray

from ..solids import box, mirrored, rod, union

FEWEST_PARTS, MOST_PARTS = 2, 6  # that join the first one
PAIRED_SHARE = 0.6  # of the parts: there is one on either side of the mirror plane
Array = NDArray[np.float64]


def assembly(rng: Generator) -> Manifold:
    """A solid symmetric about z = 0; lengths are arbitrary."""
    centres, sizes = [np.zeros(3)], [rng.uniform(0.15, 0.8, 3)]
    pieces = [_part(rng, centres[0], sizes[0])]
    for _ in range(int(rng.integers(FEWEST_PARTS, MOST_PARTS + 1))):
        host = int(rng.integers(len(centres)))
        paired = rng.random() < PAIRED_SHARE
        size = np.exp(rng.uniform(np.log(0.05), np.log(0.7), 3))
        toward = rng.uniform(-1.0, 1.0, 3)
        toward /= np.abs(toward).max()  # a point on the surface of the host's box
        centre = centres[host] + 0.5 * sizes[host] * toward + 0.35 * size * rng.uniform(-1.0, 1.0, 3)
        if not paired:
            centre[2] = 0.0
        centres.append(centre)
        sizes.append(size)
        piece = _part(rng, centre, size)
        pieces.append(mirrored(piece) if paired else piece)
    return union(pieces)


def _part(rng: Generator, centre: Array, size: Array) -> Manifold:
    """A box, an ellipsoid or a rod that fills the box of this centre and size."""
    x, y, z = centre
    kind = rng.choice(["box", "ellipsoid", "rod"])
    if kind == "box":
        return box(tuple(size), (x, y, z))
    if kind == "ellipsoid":
        return Manifold.sphere(0.5, 24).scale(tuple(size)).translate((x, y, z))
    upright = rod((0.0, -0.5, 0.0), (0.0, 0.5, 0.0), 0.5, rng.uniform(0.2, 0.5))
    return upright.scale(tuple(size)).translate((x, y, z))
