"""How near a mesh is to ground truth: EMD, Chamfer-l2, F-score, volumetric IoU, 2D IoU.

The 3D metrics compare point clouds drawn uniformly by area. Lengths are in one of two normalisations:

- "shared": both meshes are moved by the ground truth's box centre and scaled so that the ground truth's
  longest side is 2. A wrong size or place counts.
- "own": each cloud is divided by half its own longest side and not moved, as in the published evaluation of
  REFINE (arXiv 2108.09911). A wrong overall size does not count.

The same seeds draw the same random numbers for every mesh, so that comparing before and after is less noisy
than either number alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from ..cameras.seen import silhouette_iou
from ..errors import MeshInvalid
from ..values import Mesh, View
from .winding import winding_numbers

Array = NDArray[np.float64]
Normalisation = Literal["shared", "own"]

SURFACE_POINTS = 10_000  # per mesh, for Chamfer-l2 and F-score: the published number
EMD_POINTS = 2_048  # per mesh: the exact assignment costs a second or two at this size
VOLUME_POINTS = 100_000  # in the common box, for the volumetric IoU
F_SCORE_THRESHOLD = 0.05  # in normalised units: 2.5 % of the longest side, the published number
GROUND_TRUTH_SEED = 100  # added to a seed: the two clouds must not share their random numbers


@dataclass(frozen=True)
class SurfacePoints:
    """A true surface of which only points are known, spread evenly over it."""

    points: Tensor  # (P, 3) float32, world units

    def __post_init__(self) -> None:
        p = self.points
        if p.ndim != 2 or p.shape[1] != 3 or p.dtype != torch.float32 or len(p) == 0:
            raise MeshInvalid(f"expected surface points (P, 3) float32, got {tuple(p.shape)} {p.dtype}")
        if not torch.isfinite(p).all():
            raise MeshInvalid("expected finite surface points, got NaN or infinity among them")


@dataclass(frozen=True)
class Scores:
    """The metrics of one mesh against its ground truth."""

    emd: float
    """Earth mover's distance, normalised units. Two clouds of one surface score about 0.03 to 0.1, not 0."""
    chamfer_l2: float
    """Sum of both mean squared distances, squared normalised units x 1000."""
    f_score: float
    """Per cent, at a distance of 0.05 normalised units."""
    volumetric_iou: float | None
    """In [0, 1]; None where the truth is points, which enclose nothing."""
    silhouette_iou: float | None
    """2D IoU in [0, 1] in the given view; None without a view."""


def evaluate(
    predicted: Mesh,
    ground_truth: Mesh | SurfacePoints,
    *,
    normalisation: Normalisation = "shared",
    seeds: Sequence[int] = range(5),
    view: View | None = None,
) -> Scores:
    """Score a mesh against ground truth in the same frame.

    Chamfer-l2 and F-score are means over `seeds`; EMD and the volumetric IoU, which cost more and spread
    less, are of the first seed. For the volumetric IoU "own" divides each mesh by its own box. Of a truth
    that is points all are compared, whatever the seed.

    Raises:
        MeshInvalid: a mesh has no surface area.
    """
    if not seeds:
        raise ValueError("expected at least one seed, got none")
    surfaces = [_corners(predicted), _corners(ground_truth)]  # (F, 3, 3) each, or (P, 3)
    if normalisation == "shared":
        corners = surfaces[1].reshape(-1, 3)
        centre, half_side = (corners.min(0) + corners.max(0)) / 2, _half_longest_side(corners)
        surfaces = [(surface - centre) / half_side for surface in surfaces]
    rows, clouds_of_seed = [], []
    for seed in seeds:
        clouds = [
            _cloud(surface, np.random.default_rng(seed + offset))
            for surface, offset in zip(surfaces, (0, GROUND_TRUTH_SEED), strict=True)
        ]
        if normalisation == "own":
            clouds = [cloud / _half_longest_side(cloud) for cloud in clouds]
        clouds_of_seed.append(clouds)
        distances = nearest_distances(*clouds)
        rows.append((chamfer_l2(*distances), f_score(*distances)))
    fewest = min(EMD_POINTS, *(len(cloud) for cloud in clouds_of_seed[0]))
    first = [cloud[:fewest] for cloud in clouds_of_seed[0]]
    if normalisation == "own":
        surfaces = [surface / _half_longest_side(surface.reshape(-1, 3)) for surface in surfaces]
    volume = None
    if isinstance(ground_truth, Mesh):
        volume = volumetric_iou(surfaces[0], surfaces[1], np.random.default_rng(seeds[0]))
    chamfer, f = np.mean(rows, 0)
    return Scores(
        emd=earth_mover_distance(first[0], first[1]),
        chamfer_l2=float(chamfer),
        f_score=float(f),
        volumetric_iou=volume,
        silhouette_iou=None if view is None else silhouette_iou(predicted, view),
    )


def sample_surface(triangles: Array, count: int, rng: Generator) -> Array:
    """Points (count, 3) on triangles (F, 3, 3), uniform by area."""
    a, b, c = triangles.transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    if not areas.sum() > 0.0:
        raise MeshInvalid("expected a mesh with a surface, got one whose triangles all have zero area")
    uniform = rng.random((count, 3))
    share = np.cumsum(areas) / areas.sum()
    face = np.minimum(np.searchsorted(share, uniform[:, 0], side="right"), len(areas) - 1)
    root = np.sqrt(uniform[:, 1:2])  # Osada et al. 2002: uniform in a triangle
    along = uniform[:, 2:]
    points: Array = (1 - root) * a[face] + root * (1 - along) * b[face] + root * along * c[face]
    return points


def nearest_distances(cloud: Array, reference: Array) -> tuple[Array, Array]:
    """Distance of each point (N, 3) to the nearest of `reference` (M, 3), and the other way: (N,), (M,)."""
    return cKDTree(reference).query(cloud)[0], cKDTree(cloud).query(reference)[0]


def chamfer_l2(to_reference: Array, to_cloud: Array) -> float:
    """Mean squared distance one way plus the other way, x 1000, from `nearest_distances`.

    The sum, as PyTorch3D's `chamfer_distance` and the paper; OccNet reports half of it.
    """
    return 1000.0 * float((to_reference**2).mean() + (to_cloud**2).mean())


def f_score(to_reference: Array, to_cloud: Array, threshold: float = F_SCORE_THRESHOLD) -> float:
    """Harmonic mean, in per cent, of precision and recall, from `nearest_distances`.

    Precision is the share of predicted points nearer than `threshold` to the ground truth, recall the share
    of ground-truth points nearer than it to the prediction (Tatarchenko et al. 2019, arXiv 1905.03678).
    """
    precision, recall = float((to_reference < threshold).mean()), float((to_cloud < threshold).mean())
    return 200.0 * precision * recall / max(precision + recall, 1e-9)


def earth_mover_distance(cloud: Array, reference: Array) -> float:
    """Mean distance of the best one-to-one assignment between two clouds (N, 3): exact, not an auction.

    min over permutations p of 1/N sum_i || cloud_i - reference_p(i) ||.
    """
    if cloud.shape != reference.shape:
        raise ValueError(f"expected two clouds of one size, got {cloud.shape} and {reference.shape}")
    cost = cdist(cloud, reference)
    rows, columns = linear_sum_assignment(cost)
    return float(cost[rows, columns].mean())


def volumetric_iou(triangles: Array, reference: Array, rng: Generator, points: int = VOLUME_POINTS) -> float:
    """Volume of the intersection over that of the union, by `points` uniform samples of the box around both.

    Inside is where the winding number's magnitude is above one half: right for closed meshes whichever way
    they are wound, a graceful guess on open ones. Triangles (F, 3, 3). Standard error: about the root of
    IoU (1 - IoU) / n with n samples in the union; 0 when neither mesh holds a sample.
    """
    corners = np.concatenate([triangles, reference]).reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    samples = low + rng.random((points, 3)) * (high - low)
    inside = [_inside(mesh, samples) for mesh in (triangles, reference)]
    union = int((inside[0] | inside[1]).sum())
    return float((inside[0] & inside[1]).sum() / union) if union else 0.0


def _inside(triangles: Array, samples: Array) -> NDArray[np.bool_]:
    """Samples (P, 3) inside the mesh; those outside its box are not looked at."""
    corners = triangles.reshape(-1, 3)
    inside: NDArray[np.bool_] = ((samples >= corners.min(0)) & (samples <= corners.max(0))).all(1)
    inside[inside] = np.abs(winding_numbers(triangles, samples[inside])) > 0.5
    return inside


def _corners(surface: Mesh | SurfacePoints) -> Array:
    """The triangles of a mesh (F, 3, 3), or points (P, 3)."""
    if isinstance(surface, SurfacePoints):
        points: Array = surface.points.detach().cpu().double().numpy()
        return points
    triangles: Array = surface.vertices.detach().cpu().double()[surface.faces.cpu()].numpy()
    return triangles


def _cloud(surface: Array, rng: Generator) -> Array:
    """Points of triangles, drawn by area; or all points in a random order."""
    if surface.ndim == 3:
        return sample_surface(surface, SURFACE_POINTS, rng)
    return surface[rng.permutation(len(surface))]


def _half_longest_side(points: Array) -> float:
    return float(np.ptp(points, 0).max()) / 2
