"""`refine camera` on samples with a known camera, and runs with a camera that is estimated."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from refine_engine.commands.camera import camera_command
from refine_engine.commands.run import run_command
from refine_proto.camera_files import read_camera_file
from refine_proto.cameras import EstimatedCamera, LookAtCamera
from refine_proto.models import CameraEstimate

SAMPLES = Path(__file__).parents[2] / "examples" / "samples"


def files(name: str) -> list[str]:
    return [str(SAMPLES / name / file) for file in ("coarse.obj", "silhouette.png")]


def apart(estimate: CameraEstimate, name: str) -> float:
    """Degrees between the directions of the estimate and of the sample's camera."""
    true = read_camera_file(SAMPLES / name / "camera.json")
    assert isinstance(true, LookAtCamera)
    (a, e), (b, f) = (
        (math.radians(one.azimuth_degrees), math.radians(one.elevation_degrees)) for one in (estimate, true)
    )
    cos = math.cos(e) * math.cos(f) * math.cos(a - b) + math.sin(e) * math.sin(f)
    return math.degrees(math.acos(min(1.0, cos)))


@pytest.mark.parametrize("name", ["airplane", "chair"])
def test_the_camera_of_a_sample_is_found_and_can_be_sent(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "camera.json"
    assert camera_command([*files(name), "-o", str(target), "--json"]) == 0
    estimate = CameraEstimate.model_validate_json(capsys.readouterr().out)
    assert apart(estimate, name) < 15
    assert read_camera_file(target) == estimate.camera
    assert estimate.alternatives


def test_people_get_a_line_for_every_direction(capsys: pytest.CaptureFixture[str]) -> None:
    argv = [*files("chair"), "--azimuth-degrees", "50", "--elevation-degrees", "20", "--fov-x-degrees", "60"]
    assert camera_command(argv) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith("camera       azimuth ")
    assert others
    assert all(line.startswith("alternative  azimuth ") for line in others)


def test_what_is_known_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert camera_command([*files("chair"), "--fov-x-degrees", "60", "--fov-y-degrees", "60"]) == 2
    assert "expected at most one of fov_y_degrees and fov_x_degrees" in capsys.readouterr().err


def test_a_run_with_an_estimated_camera_tells_which(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = [
        *files("chair"),
        "--camera",
        "estimate",
        "-o",
        str(tmp_path / "out"),
        "--iterations",
        "2",
        "--json",
    ]
    assert run_command(argv) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    shown: Any = next(line["refinement"] for line in lines if line.get("type") == "completed")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert CameraEstimate.model_validate(report["camera"]) == CameraEstimate.model_validate(shown["camera"])
    assert report["silhouette_iou"]["before"] == pytest.approx(report["camera"]["silhouette_iou"])
    assert apart(CameraEstimate.model_validate(report["camera"]), "chair") < 15


def test_a_further_view_has_to_be_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh, silhouette = files("chair")
    camera = str(SAMPLES / "chair" / "camera.json")
    argv = [
        mesh,
        silhouette,
        "--camera",
        camera,
        "--view",
        silhouette,
        "estimate",
        "-o",
        str(tmp_path / "out"),
    ]
    assert run_command(argv) == 2
    assert "expected a camera that is known, got type estimate" in capsys.readouterr().err


def test_the_word_is_no_file() -> None:
    assert read_camera_file("estimate") == EstimatedCamera()
