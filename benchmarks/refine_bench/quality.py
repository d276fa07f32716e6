"""Presets and seeds against ground truth: refine whole folders of cases and score what comes out.

A case is a folder with `coarse.obj`, `silhouette.png`, `camera.json` and, if known, `gt.obj`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refine_engine.cameras.seen import mean_silhouette_iou
from refine_engine.method.config import RefineConfig
from refine_engine.scores.scores import (
    GROUND_TRUTH_SEED,
    SURFACE_POINTS,
    Array,
    chamfer_l2,
    f_score,
    nearest_distances,
    sample_surface,
)
from refine_engine.values import Mesh

from .measure import read_case, read_mesh_file

SCORING_SEEDS = range(5)


@dataclass(frozen=True)
class Score:
    """One case before and after; Chamfer-l2 and F-score are None without ground truth."""

    case: str
    iou: tuple[float, float]
    chamfer: tuple[float, float] | None
    f: tuple[float, float] | None


def cases_of(folders: Iterable[Path]) -> list[Path]:
    """The case folders in `folders`, sorted by name."""
    found = [path.parent for folder in folders for path in folder.glob("*/camera.json")]
    return sorted(found, key=lambda case: case.name)


def refine_case(case: Path, config: RefineConfig, output: Path) -> None:
    """Write `output`/refined.glb, unless it is there."""
    target = output / "refined.glb"
    if target.exists():
        return
    inputs = read_case(case)
    result = inputs.refine(config)
    output.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_suffix(".part")
    vertices, kept = result.mesh.vertices, result.kept_faces
    unfinished.write_bytes(inputs.mesh_file.with_vertices(vertices, result.confidence, kept))
    unfinished.rename(target)


def score_case(case: Path, refined: Path) -> Score:
    """`refined` and the coarse mesh against the ground truth, in its normalisation ("shared")."""
    inputs = read_case(case)
    meshes = inputs.mesh_file.mesh, read_mesh_file(refined)
    before, after = (mean_silhouette_iou(mesh, inputs.views) for mesh in meshes)
    truth = case / "gt.obj"
    if not truth.exists():
        return Score(case.name, (before, after), None, None)
    reference = _triangles(read_mesh_file(truth))
    low, high = reference.min((0, 1)), reference.max((0, 1))
    centre, half_side = (low + high) / 2, (high - low).max() / 2
    scores = [
        compare((_triangles(mesh) - centre) / half_side, (reference - centre) / half_side) for mesh in meshes
    ]
    (chamfer_before, f_before), (chamfer_after, f_after) = scores
    return Score(case.name, (before, after), (chamfer_before, chamfer_after), (f_before, f_after))


def _triangles(mesh: Mesh) -> Array:
    triangles: Array = mesh.vertices.double()[mesh.faces].numpy()
    return triangles


def compare(triangles: Array, reference: Array) -> tuple[float, float]:
    """(Chamfer-l2, F-score), means over the seeds."""
    rows = []
    for seed in SCORING_SEEDS:
        cloud = sample_surface(triangles, SURFACE_POINTS, np.random.default_rng(seed))
        truth = sample_surface(reference, SURFACE_POINTS, np.random.default_rng(seed + GROUND_TRUTH_SEED))
        distances = nearest_distances(cloud, truth)
        rows.append((chamfer_l2(*distances), f_score(*distances)))
    chamfer, f = np.mean(rows, 0)
    return float(chamfer), float(f)


@dataclass(frozen=True)
class Summary:
    """Over the cases of one preset and seed; the 3D numbers over those with ground truth."""

    chamfer_ratio: float  # geometric mean of after / before
    worst_ratio: float
    worst_case: str
    f_gain: float
    iou_before: float
    iou_after: float

    @staticmethod
    def of(scores: Sequence[Score]) -> Summary:
        ratio = {s.case: s.chamfer[1] / s.chamfer[0] for s in scores if s.chamfer}
        worst = max(ratio, key=lambda case: ratio[case], default="-")
        gains = [s.f[1] - s.f[0] for s in scores if s.f]
        return Summary(
            float(np.exp(np.mean(np.log(list(ratio.values()))))) if ratio else float("nan"),
            ratio.get(worst, float("nan")),
            worst,
            float(np.mean(gains)) if gains else float("nan"),
            float(np.mean([s.iou[0] for s in scores])),
            float(np.mean([s.iou[1] for s in scores])),
        )


def mean(summaries: Sequence[Summary]) -> Summary:
    """Over the seeds of one preset: the geometric mean of the ratios, the worst of the worst."""
    worst = max(summaries, key=lambda s: s.worst_ratio)
    return Summary(
        float(np.exp(np.mean([np.log(s.chamfer_ratio) for s in summaries]))),
        worst.worst_ratio,
        worst.worst_case,
        *(
            float(np.mean([getattr(s, name) for s in summaries]))
            for name in ("f_gain", "iou_before", "iou_after")
        ),
    )
