"""Count what the checks of the inputs find when nothing is wrong, and when one thing is, as Markdown.

    python benchmarks/input_checks.py                      SyntheticShift, from the installed package
    python benchmarks/input_checks.py CASES [CASES ...]    as `refine bench folder` reads them

Every case is checked as it is, and once for each way to get it wrong: its camera written down otherwise, its
mask inverted, its mesh in another unit. A mistake counts as seen when anything is found, and as named when
the reading that is offered has the 2D IoU of the true camera again. One that costs less than 0.1 of 2D IoU
cannot be seen in the picture, and is counted apart.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from refine_bench.cases import Case
from refine_bench.sets.folder import folder_cases
from refine_bench.sets.synthetic import synthetic_cases
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.cameras.spec import camera_from_spec, read_camera
from refine_engine.checks.check import check_inputs
from refine_engine.checks.look import BETTER_IOU
from refine_engine.values import Camera, Mesh, View
from refine_proto.checks import Code, Finding, Severity

Array = NDArray[np.float64]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
PYTORCH3D = np.diag([-1.0, -1.0, 1.0, 1.0])
Z_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
)  # the world with Y up in one with Z up
NOTHING = "nothing"


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("cases", nargs="*", type=Path, help="folders of cases; none: SyntheticShift")
    parser.add_argument("--verbose", action="store_true", help="also print every right case with a finding")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    cases = [case for root in options.cases for case in folder_cases(root)] or synthetic_cases()
    print("\n".join(table(cases, options.verbose)))


def table(cases: Sequence[Case], verbose: bool) -> list[str]:
    """The lines of the Markdown table."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    seconds = []
    lines = []
    for case in cases:
        scene = case.load()
        mesh, view = scene.coarse, scene.view
        right = silhouette_iou(mesh, view)
        for name, wrong_mesh, wrong_view, spec in (
            (NOTHING, mesh, view, _matrix(view.camera)),
            *mistakes(mesh, view),
        ):
            started = time.perf_counter()
            findings = check_inputs(wrong_mesh, wrong_view, read_camera(spec))
            seconds.append(time.perf_counter() - started)
            wrong = silhouette_iou(wrong_mesh, wrong_view)
            counts[name][_outcome(name, findings, right, wrong)] += 1
            if name == NOTHING and findings and verbose:
                lines.append(f"{case.name}: {'; '.join(finding.message for finding in findings)}")
    lines += [
        "| what is wrong | cases | named | seen | cannot be seen | silent |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in counts.items():
        total = sum(row.values())
        seen = row["named"] + row["seen"]
        lines.append(f"| {name} | {total} | {row['named']} | {seen} | {row['harmless']} | {row['silent']} |")
    median, longest = statistics.median(seconds) * 1000, max(seconds[1:]) * 1000
    lines += ["", f"A check takes {median:.0f} ms (median), {longest:.0f} ms (longest)."]
    return lines


def _outcome(name: str, findings: Sequence[Finding], right: float, wrong: float) -> str:
    if any(_names(finding, name, right) for finding in findings):
        return "named"
    if findings:
        return "seen"
    return "silent" if wrong < right - BETTER_IOU and name != NOTHING else "harmless"


def _names(finding: Finding, name: str, right: float) -> bool:
    if name == "mask inverted":
        return finding.code is Code.SILHOUETTE_INVERTED and finding.severity is Severity.REFUSED
    return finding.reading is not None and finding.reading.silhouette_iou > right - 0.02


Mistake = tuple[str, Mesh, View, Mapping[str, Any]]


def mistakes(mesh: Mesh, view: View) -> Iterator[Mistake]:
    """The same mesh and picture with one thing wrong; the spec says what the camera was said to be."""
    camera = view.camera
    look = _look_at(camera)
    for name, change in (_ANGLES if look else {}).items():
        yield _with_camera(name, mesh, view, change(dict(look or {})))
    for name, spec in _matrices(camera).items():
        yield _with_camera(name, mesh, view, spec)
    for unit in (10, 100, 1000):
        scaled = Mesh(mesh.vertices * unit, mesh.faces)
        yield _with_camera(f"mesh {unit} times too large", scaled, view, _matrix(camera))
        scaled = Mesh(mesh.vertices / unit, mesh.faces)
        yield _with_camera(f"mesh {unit} times too small", scaled, view, _matrix(camera))
    yield "mask inverted", mesh, View(1.0 - (view.silhouette > 0.5).float(), camera), _matrix(camera)


def _with_camera(name: str, mesh: Mesh, view: View, spec: Mapping[str, Any]) -> Mistake:
    wrong = camera_from_spec(read_camera(spec), view.camera.width, view.camera.height)
    return name, mesh, View(view.silhouette, wrong), spec


Look = dict[str, Any]
_ANGLES: Mapping[str, Callable[[Look], Look]] = {
    "azimuth negated": lambda look: look | {"azimuth_degrees": -look["azimuth_degrees"]},
    "elevation negated": lambda look: look | {"elevation_degrees": -look["elevation_degrees"]},
    "azimuth +90": lambda look: look | {"azimuth_degrees": look["azimuth_degrees"] + 90},
    "azimuth -90": lambda look: look | {"azimuth_degrees": look["azimuth_degrees"] - 90},
    "azimuth +180": lambda look: look | {"azimuth_degrees": look["azimuth_degrees"] + 180},
    "azimuth counted from +X": lambda look: look | {"azimuth_degrees": 90 - look["azimuth_degrees"]},
    "azimuth and elevation in radians": lambda look: (
        look | {name: math.radians(look[name]) for name in ("azimuth_degrees", "elevation_degrees")}
    ),
    "fov_y in radians": lambda look: look | {"fov_y_degrees": math.radians(look["fov_y_degrees"])},
}


def _look_at(camera: Camera) -> Look | None:
    """The camera as a look_at, if it is one."""
    pose = camera.world_to_camera.double().numpy()
    x, y, z = -pose[:3, :3].T @ pose[:3, 3]
    distance = math.sqrt(x * x + y * y + z * z)
    if distance < 1e-6 or camera.cx != camera.width / 2 or camera.projection != "perspective":
        return None
    look = {
        "type": "look_at",
        "azimuth_degrees": math.degrees(math.atan2(x, z)),
        "elevation_degrees": math.degrees(math.asin(y / distance)),
        "distance": distance,
        "fov_y_degrees": 2 * math.degrees(math.atan(camera.height / 2 / camera.fy)),
    }
    same = camera_from_spec(read_camera(look), camera.width, camera.height)
    return look if torch.allclose(same.world_to_camera, camera.world_to_camera, atol=1e-3) else None


def _matrix(camera: Camera, **changes: Any) -> dict[str, Any]:
    """The camera in OpenCV's axes, with some fields otherwise."""
    spec = {
        "type": "matrix",
        "convention": "opencv",
        "world_to_camera": camera.world_to_camera.tolist(),
        "intrinsics": {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        "projection": camera.projection,
    } | changes
    return {name: value for name, value in spec.items() if value is not None}


def _matrices(camera: Camera) -> dict[str, dict[str, Any]]:
    """What the numbers of a true matrix camera become in wrong hands."""
    pose = camera.world_to_camera.double().numpy()
    transposed = PYTORCH3D @ pose
    transposed[:3, :3] = transposed[:3, :3].T.copy()
    x, y, width, height = camera.fx, camera.fy, camera.width, camera.height

    def told(convention: str, matrix: Array, to_camera: bool = True) -> dict[str, Any]:
        given, other = ("world_to_camera", "camera_to_world")[:: 1 if to_camera else -1]
        return _matrix(camera, convention=convention) | {given: matrix.tolist()} | {other: None}

    def lens(fx: float, fy: float, cx: float, cy: float) -> dict[str, Any]:
        return _matrix(camera, intrinsics={"fx": fx, "fy": fy, "cx": cx, "cy": cy})

    specs = {
        "PyTorch3D's R not transposed": told("pytorch3d", transposed),
        "opengl told as opencv": told("opencv", OPENGL @ pose),
        "opencv told as pytorch3d": told("pytorch3d", pose),
        "opengl camera_to_world told as opencv": told("opencv", np.linalg.inv(OPENGL @ pose), False),
        "camera_to_world told as world_to_camera": told("opencv", np.linalg.inv(pose)),
        "world_to_camera told as camera_to_world": told("opengl", OPENGL @ pose, False),
        "camera of a world with Z up": told("opengl", np.linalg.inv(OPENGL @ pose @ Z_UP.T), False),
        "intrinsics of an image half as large": lens(x / 2, y / 2, camera.cx / 2, camera.cy / 2),
        "intrinsics of an image four times as large": lens(4 * x, 4 * y, 4 * camera.cx, 4 * camera.cy),
        "normalised intrinsics": lens(x / width, y / height, camera.cx / width, camera.cy / height),
        "principal point counted from the middle": lens(x, y, camera.cx - width / 2, camera.cy - height / 2),
    }
    return {
        name: {key: value for key, value in spec.items() if value is not None} for name, spec in specs.items()
    }


if __name__ == "__main__":
    main()
