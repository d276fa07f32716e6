"""`refine check` on a box of its own, on the samples, and on the shared mistakes where they are."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from refine_engine.commands.check import check_command
from refine_engine.commands.run import run_command

ROOT = Path(__file__).parents[2]
SAMPLES = sorted((ROOT / "examples" / "samples").iterdir())
BUGCASES = Path(os.environ.get("REFINE_SHARED", ROOT.parent / "shared")) / "bugcases"
WRONG_CAMERA = "01-wrong-camera-silent"
INVERTED = "02-inverted-mask-silent"
UNITS = "03-units-intrinsics-silent"
MISTAKES = [  # folder, mesh, silhouette, camera; code, words of its message
    (WRONG_CAMERA, "mesh.ply", "sil.png", "azimuth_negated", "CAMERA_MISREAD", "azimuth negated"),
    (WRONG_CAMERA, "mesh.ply", "sil.png", "azimuth_plus_90", "CAMERA_MISREAD", "azimuth -90"),
    (WRONG_CAMERA, "mesh.ply", "sil.png", "elevation_negated", "CAMERA_MISREAD", "elevation negated"),
    (WRONG_CAMERA, "mesh.ply", "sil.png", "blender_z_up_camera", "CAMERA_MISREAD", "a world with Z up"),
    (WRONG_CAMERA, "mesh.ply", "sil.png", "pytorch3d_R_not_transposed", "CAMERA_MISREAD", "transposed"),
    (INVERTED, "mesh.ply", "black_on_white.png", "camera", "SILHOUETTE_INVERTED", "invert it"),
    (INVERTED, "mesh.ply", "inpainting_style_alpha.png", "camera", "SILHOUETTE_INVERTED", "invert it"),
    (UNITS, "mesh.ply", "sil.png", "intrinsics_of_half_size", "NO_OVERLAP", "an image of 128x128 pixels"),
    (UNITS, "mesh.ply", "sil.png", "normalised_intrinsics", "NO_OVERLAP", "divided by the image's width"),
    (UNITS, "mesh_mm.ply", "sil.png", "camera", "CAMERA_INSIDE_OBJECT", "lengths times 1000"),
]  # fmt: skip
RIGHT = [
    (WRONG_CAMERA, "mesh.ply", "sil.png", "true"),
    (UNITS, "mesh.ply", "sil.png", "camera"),
    ("12-stray-fragment", "fragment_at_3.ply", "sil.png", "camera"),
    ("12-stray-fragment", "fragment_at_30.ply", "sil.png", "camera"),
    ("15-soft-edges", "mesh.ply", "sil_sharp.png", "camera"),
    ("16-occlusion", "mesh.ply", "sil_occluded.png", "camera"),
]
here = pytest.mark.skipif(not BUGCASES.is_dir(), reason="the shared mistakes are not here")


def check(capsys: pytest.CaptureFixture[str], *argv: Path | str) -> tuple[int, dict[str, Any]]:
    """Exit code and what was found."""
    code = check_command([*map(str, argv), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.fixture
def sample(tmp_path: Path) -> list[Path | str]:
    """The car from a camera whose azimuth was negated."""
    car = ROOT / "examples" / "samples" / "car"
    camera = json.loads((car / "camera.json").read_text())
    camera["azimuth_degrees"] *= -1
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    return [car / "coarse.obj", car / "silhouette.png", "--camera", tmp_path / "camera.json"]


@pytest.mark.parametrize("folder", SAMPLES, ids=lambda folder: folder.name)
def test_nothing_looks_wrong_with_the_samples(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, validation = check(
        capsys, folder / "coarse.obj", folder / "silhouette.png", "--camera", folder / "camera.json"
    )
    assert (code, validation["accepted"], validation["checks"]) == (0, True, [])


@here
@pytest.mark.parametrize(("folder", "mesh", "silhouette", "camera"), RIGHT)
def test_nothing_looks_wrong_with_what_is_right(
    folder: str, mesh: str, silhouette: str, camera: str, capsys: pytest.CaptureFixture[str]
) -> None:
    case = BUGCASES / folder
    code, validation = check(capsys, case / mesh, case / silhouette, "--camera", case / f"{camera}.json")
    assert (code, validation["checks"]) == (0, [])


@here
@pytest.mark.parametrize(("folder", "mesh", "silhouette", "camera", "code", "words"), MISTAKES)
def test_mistakes_get_the_right_word(
    folder: str,
    mesh: str,
    silhouette: str,
    camera: str,
    code: str,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And the camera that is offered instead is right: nothing is found with it."""
    case = BUGCASES / folder
    exit_code, validation = check(capsys, case / mesh, case / silhouette, "--camera", case / f"{camera}.json")
    finding = validation["checks"][0]
    assert finding["code"] == code
    assert words in finding["message"]
    assert exit_code == (0 if code == "CAMERA_MISREAD" else 2)


def test_the_camera_that_is_offered_is_the_right_one(
    sample: list[Path | str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, validation = check(capsys, *sample)
    (finding,) = validation["checks"]
    assert (code, finding["code"]) == (0, "CAMERA_MISREAD")
    assert finding["message"] in validation["warnings"]
    (tmp_path / "camera.json").write_text(json.dumps(finding["reading"]["camera"]))
    code, validation = check(capsys, *sample)
    assert (code, validation["checks"]) == (0, [])
    assert validation["silhouette_iou"] == pytest.approx(finding["reading"]["silhouette_iou"], abs=0.03)


def test_lines_for_people_and_what_strict_refuses(
    sample: list[Path | str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check_command([*map(str, sample), "--checks", "strict"]) == 2
    verdict, line = capsys.readouterr().out.splitlines()
    assert verdict.startswith("refused, 2D IoU 0.")
    assert line.startswith("refused CAMERA_MISREAD: expected a camera by which ")
    assert run_command([*map(str, sample), "-o", str(tmp_path / "out"), "--checks", "strict"]) == 2
    assert "error: CAMERA_INVALID: expected a camera by which" in capsys.readouterr().err
    assert check_command([*map(str, sample), "--checks", "off"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_what_is_said_about_the_file_comes_after_the_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.3, 0.3) for z in (-0.2, 0.2)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c} {d}" for a, b, c, d in quads]
    (tmp_path / "box.obj").write_text("\n".join([*lines, "f 1 1 2"]))
    camera = {"type": "look_at", "azimuth_degrees": 0, "elevation_degrees": 0, "distance": 2}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    pixels = np.zeros((64, 64), np.uint8)
    pixels[22:42, 16:48] = 255
    Image.fromarray(pixels).save(tmp_path / "silhouette.png")
    inputs = [
        str(tmp_path / "box.obj"),
        str(tmp_path / "silhouette.png"),
        "--camera",
        str(tmp_path / "camera.json"),
    ]
    assert check_command(inputs) == 0
    verdict, line = capsys.readouterr().out.splitlines()
    assert verdict.startswith("can be refined, 2D IoU 0.")
    assert line.startswith("warning: ")
    assert "1 of 13 triangles" in line


def test_what_cannot_be_read_is_an_error(
    sample: list[Path | str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert check_command([*map(str, sample[:3]), str(ROOT / "nowhere.json")]) == 2
    assert "error: INPUT_INVALID: expected a file that can be read" in capsys.readouterr().err
