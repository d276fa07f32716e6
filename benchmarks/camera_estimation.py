"""Prints how well cameras are estimated: python benchmarks/camera_estimation.py [FOLDER ...] [--made]

The cases are folders with coarse.obj, silhouette.png and the true camera.json, and with --made the small
SyntheticShift, which is made here. With --refine PRESET each is refined with the estimated and with the true
camera: minutes.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from refine_bench.cases import Case, Scene
from refine_bench.sets.folder import folder_cases
from refine_bench.sets.synthetic import synthetic_cases
from refine_engine import Camera, Mesh, View, make_config, refine
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.estimation.estimate import Hint, estimate_camera, mirrored
from refine_engine.method.planes import find_mirror_plane
from refine_engine.method.presets import PRESETS
from refine_engine.scores.scores import evaluate
from refine_engine.values import field_of_view

NEAR_DEGREES = 10.0


@dataclass(frozen=True)
class Row:
    """One estimate. Degrees are between the directions from the middle of the mesh to the cameras."""

    off_degrees: float  # from the true direction
    mirrored_degrees: float  # from the nearest of it and its mirror images
    runner_up_degrees: float  # of the nearest of the estimate and its alternatives from the true direction
    iou: float  # 2D IoU of the coarse mesh by the estimated camera
    true_iou: float  # by the true one
    seconds: float
    gain: float | None = None  # of the F-score, when refined with the estimated camera
    true_gain: float | None = None  # with the true one


def direction(mesh: Mesh, camera: Camera) -> Tensor:
    """(3,) unit, from the middle of the mesh to the camera."""
    low, high = mesh.box()
    pose = camera.world_to_camera
    return F.normalize(-pose[:3, :3].T @ pose[:3, 3] - (low + high) / 2, dim=0)


def degrees(one: Tensor, other: Tensor) -> float:
    """Between two unit vectors."""
    return math.degrees(math.acos(max(-1.0, min(1.0, float(one @ other)))))


def measure(scene: Scene, known_lens: bool, preset: str | None) -> Row:
    """Estimate the camera of a scene, and refine with it and with the true one by the preset, if any."""
    mesh, view = scene.coarse, scene.view
    fov = field_of_view(view.camera.fy, view.camera.height)
    started = time.perf_counter()
    found = estimate_camera(mesh, view.silhouette, view.known, Hint(fov if known_lens else None))
    seconds = time.perf_counter() - started
    true, plane = direction(mesh, view.camera), find_mirror_plane(mesh)
    images = [true, *mirrored(true, None if plane is None else plane.normal)]
    off = [degrees(direction(mesh, candidate.camera), true) for candidate in found]
    gains: tuple[float, ...] = ()
    if preset is not None and scene.ground_truth is not None:
        gains = gained(scene, found[0].camera, preset), gained(scene, view.camera, preset)
    return Row(
        off[0],
        min(degrees(direction(mesh, found[0].camera), image) for image in images),
        min(off),
        found[0].silhouette_iou,
        silhouette_iou(mesh, view),
        seconds,
        *gains,
    )


def gained(scene: Scene, camera: Camera, preset: str) -> float:
    """By how much refining with the camera raises the F-score against the ground truth."""
    view = View(scene.view.silhouette, camera, scene.view.known)
    result = refine(scene.coarse, [view], make_config(preset))
    assert scene.ground_truth is not None
    before, after = (
        evaluate(mesh, scene.ground_truth, seeds=[0]).f_score for mesh in (scene.coarse, result.mesh)
    )
    return after - before


def line(name: str, row: Row) -> str:
    """A line of the table."""
    gain = "" if row.gain is None else f" {row.gain:+.1f} | {row.true_gain:+.1f} |"
    return (
        f"| {name} | {row.off_degrees:.0f} | {row.mirrored_degrees:.0f} | {row.runner_up_degrees:.0f} | "
        f"{row.iou:.3f} | {row.true_iou:.3f} | {row.seconds:.1f} |{gain}"
    )


def summary(name: str, rows: Sequence[Row]) -> str:
    """What all cases of a set come to."""
    count = len(rows)
    near, mirrored_near, among = (
        sum(getattr(row, which) <= NEAR_DEGREES for row in rows)
        for which in ("off_degrees", "mirrored_degrees", "runner_up_degrees")
    )
    text = (
        f"{name}: within {NEAR_DEGREES:g} degrees of the true direction {near} of {count}, of it or a mirror "
        f"image {mirrored_near}, one of the answers {among}; {sum(row.seconds for row in rows) / count:.1f} s"
    )
    gains = [(row.gain, row.true_gain) for row in rows if row.gain is not None and row.true_gain is not None]
    if gains:
        gain, true_gain = (sum(column) / len(gains) for column in zip(*gains, strict=True))
        text += f"; F-score of {len(gains)} refined {gain:+.2f}, with the true camera {true_gain:+.2f}"
    return text


def cases(folders: Sequence[Path], made: bool) -> Iterator[tuple[str, Case]]:
    """Set, case."""
    for folder in folders:
        yield from ((folder.name, case) for case in folder_cases(folder))
    if made:
        yield from (("SyntheticShift", case) for case in synthetic_cases("small"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="*", metavar="FOLDER", help="of cases")
    parser.add_argument("--made", action="store_true", help="the small SyntheticShift as well")
    parser.add_argument("--known-lens", action="store_true", help="tell the field of view")
    parser.add_argument("--refine", choices=list(PRESETS), metavar="PRESET", help="with both cameras")
    options = parser.parse_args()
    torch.set_num_threads(1)
    columns = ["case", "degrees off", "or mirrored", "best answer", "2D IoU", "of the true camera", "seconds"]
    columns += ["F-score", "with the true camera"] if options.refine else []
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    sets: dict[str, list[Row]] = {}
    for group, case in cases(options.folders, options.made):
        row = measure(case.load(), options.known_lens, options.refine)
        sets.setdefault(group, []).append(row)
        print(line(case.name, row), flush=True)
    for group, rows in sets.items():
        print(summary(group, rows))


if __name__ == "__main__":
    main()
