"""Does the confidence of symmetry say where an object is symmetric? Judged by the ground truth.

On an object that is symmetric by construction the mean confidence should be near one. On an asymmetric one
it should be lower where the true surface has no counterpart on the other side of the mirror plane: the area
under the ROC curve (AUC) is the probability that a vertex of an asymmetric place has a lower confidence than
one of a symmetric place. 1 is perfect, 0.5 is guessing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from refine_engine.scores.scores import F_SCORE_THRESHOLD, sample_surface
from refine_engine.values import Mesh

from .cases import Direction

POINTS = 40_000  # of the true surface: 0.5 to 1 % of its longest side apart
Array = NDArray[np.float64]


def mirror_distances(vertices: Array, truth: Mesh, normal: Direction, offset: float) -> Array:
    """(V,): how far the true surface is from symmetric where each vertex (V, 3) lies, in half longest sides.

    That is the distance from the nearest point of the true surface, mirrored in normal . x = offset, to the
    true surface.
    """
    corners = truth.vertices.double()[truth.faces].numpy()
    half_side = float(np.ptp(corners.reshape(-1, 3), 0).max()) / 2
    surface = sample_surface(corners, POINTS, np.random.default_rng(0))
    tree = cKDTree(surface)
    n = np.array(normal)
    nearest = surface[tree.query(vertices)[1]]
    mirrored = nearest - 2 * (nearest @ n - offset)[:, None] * n / (n @ n)
    return np.asarray(tree.query(mirrored)[0] / half_side)


def confidence_auc(confidence: Array, distances: Array) -> float | None:
    """AUC of confidences (V,) against mirror distances (V,); None where all vertices are of one kind.

    A place is asymmetric from a distance on at which the F-score counts a point as wrong.
    """
    asymmetric = distances > F_SCORE_THRESHOLD
    positive, negative = int(asymmetric.sum()), int((~asymmetric).sum())
    if positive == 0 or negative == 0:
        return None
    ranks = rankdata(-confidence)  # the lowest confidence has the highest rank; ties share theirs
    return float((ranks[asymmetric].sum() - positive * (positive + 1) / 2) / (positive * negative))
