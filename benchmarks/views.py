"""Prints what further silhouettes give: python benchmarks/views.py FOLDER ... [--preset default]

The cases are folders with coarse.obj, silhouette.png, camera.json and gt.obj. Their own silhouette is the
first view; the others are rendered from gt.obj by the same camera, turned about the object's upright axis.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from refine_bench.measure import read_case, read_mesh_file
from refine_bench.quality import compare
from refine_engine import Camera, Mesh, View, make_config
from refine_engine.cameras.seen import hard_silhouette, mean_silhouette_iou
from refine_engine.method.presets import PRESETS

COUNTS = (1, 2, 4)
TURNS_DEGREES = (90.0, 180.0, 270.0)  # from the first view
# Chamfer-l2 relative to the coarse mesh's, change of the F-score, 2D IoU over all the views there are.
Row = tuple[float, float, float]


def turned(camera: Camera, centre: torch.Tensor, degrees: float) -> Camera:
    """The camera on its circle about the upright axis through `centre` (3,)."""
    turn = torch.eye(4, dtype=torch.float64)
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = cos, -sin, sin, cos
    turn[:3, 3] = centre.double() - turn[:3, :3] @ centre.double()
    return replace(camera, world_to_camera=(camera.world_to_camera.double() @ turn).float())


def views_of(first: View, truth: Mesh) -> list[View]:
    """The case's view, then what further cameras see of the truth; most different first."""
    centre = (truth.vertices.amax(0) + truth.vertices.amin(0)) / 2
    cameras = [turned(first.camera, centre, degrees) for degrees in TURNS_DEGREES]
    return [first, *(View(hard_silhouette(truth, camera).float(), camera) for camera in cameras)]


def measure(case: Path, preset: str) -> list[Row]:
    """A row for each of COUNTS."""
    inputs, truth = read_case(case), read_mesh_file(case / "gt.obj")
    low, high = truth.vertices.amin(0), truth.vertices.amax(0)
    centre, half_side = (low + high) / 2, (high - low).max() / 2

    def score(mesh: Mesh) -> tuple[float, float]:
        surfaces = [
            ((one.vertices - centre) / half_side).double()[one.faces].numpy() for one in (mesh, truth)
        ]
        return compare(*surfaces)

    views = views_of(inputs.views[0], truth)
    chamfer, f_score = score(inputs.mesh_file.mesh)
    rows = []
    for count in COUNTS:
        result = replace(inputs, views=tuple(views[:count])).refine(make_config(preset))
        chamfer_now, f_now = score(result.mesh)
        rows.append((chamfer_now / chamfer, f_now - f_score, mean_silhouette_iou(result.mesh, views)))
    return rows


def line(name: str, rows: Sequence[Row]) -> str:
    """A line of the table."""
    return f"| {name} | " + " | ".join(f"x{c:.2f}, {f:+.1f}, {iou:.3f}" for c, f, iou in rows) + " |"


def mean(cases: Sequence[Sequence[Row]]) -> list[Row]:
    """Geometric mean of the Chamfer-l2 ratios, mean of the others, for each of COUNTS."""
    columns: list[Row] = []
    for at in range(len(COUNTS)):
        rows = [case[at] for case in cases]
        ratio = math.exp(sum(math.log(row[0]) for row in rows) / len(rows))
        f_score, iou = (sum(row[i] for row in rows) / len(rows) for i in (1, 2))
        columns.append((ratio, f_score, iou))
    return columns


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="of cases")
    parser.add_argument("--preset", choices=list(PRESETS), default="default")
    parser.add_argument("--threads", type=int, default=1, metavar="N")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"Chamfer-l2 against the coarse mesh's, F-score, 2D IoU of 4 views; preset {options.preset}\n")
    print("| case | " + " | ".join(f"{count} view{'s' if count > 1 else ''}" for count in COUNTS) + " |")
    print("|---" * (1 + len(COUNTS)) + "|")
    for folder in options.folders:
        cases = sorted(path.parent for path in folder.glob("*/gt.obj"))
        if not cases:
            parser.error(
                f"expected cases with gt.obj in {folder}, got none: silhouettes are rendered from it"
            )
        done = []
        for case in cases:
            done.append(measure(case, options.preset))
            print(line(case.name, done[-1]), flush=True)
        print(line(f"**{folder.name}, all {len(done)}**", mean(done)), flush=True)


if __name__ == "__main__":
    main()
