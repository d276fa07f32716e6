"""`refine run` from files to files, on a box of 8 vertices and a few iterations."""

import hashlib
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from PIL import Image

from refine_engine.commands import run
from refine_engine.errors import Diverged
from refine_engine.files.mesh_file import read_mesh
from refine_engine.request import Inputs
from refine_proto.models import Event, EventType, State

ARTIFACTS = [
    "confidence.glb",
    "confidence.npz",
    "confidence.png",
    "preview.png",
    "refined.glb",
    "report.json",
]
BOX = """
v -.5 -.3 -.2
v .5 -.3 -.2
v .5 .3 -.2
v -.5 .3 -.2
v -.5 -.3 .2
v .5 -.3 .2
v .5 .3 .2
v -.5 .3 .2
f 4 3 2 1
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""
CAMERA = {"type": "look_at", "azimuth_degrees": 0, "elevation_degrees": 0, "distance": 2, "fov_y_degrees": 60}
SHARED = Path(os.environ.get("REFINE_SHARED", Path(__file__).parents[3] / "shared"))


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """A folder with a box, its silhouette (a little larger than the box) and the camera."""
    (tmp_path / "box.obj").write_text(BOX)
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    pixels = np.zeros((64, 64), np.uint8)
    pixels[22:42, 16:48] = 255
    Image.fromarray(pixels).save(tmp_path / "silhouette.png")
    return tmp_path


def arguments(inputs: Path, *more: str) -> list[str]:
    return [
        *(str(inputs / "box.obj"), str(inputs / "silhouette.png")),
        *("--camera", str(inputs / "camera.json"), "-o", str(inputs / "out")),
        *("--iterations", "3", "--threads", "1", *more),
    ]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_all_artifacts_and_nothing_else(inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files(inputs)
    assert run.run_command(arguments(inputs)) == 0
    assert files(inputs / "out") == ARTIFACTS
    assert files(inputs) == sorted([*before, "out"])
    shown = capsys.readouterr()
    assert sorted(shown.out.splitlines()[1:]) == [str(inputs / "out" / name) for name in ARTIFACTS]
    assert re.fullmatch(
        r"box\.obj succeeded, 2D IoU 0\.\d{3} -> [01]\.\d{3} in \d+\.\d s", shown.out.splitlines()[0]
    )
    assert shown.err.splitlines()[0] == "running"
    assert "iteration 3/3" in shown.err


def test_refined_mesh_keeps_its_faces_and_moves_its_vertices(inputs: Path) -> None:
    assert run.run_command(arguments(inputs, "--iterations", "20")) == 0
    coarse = read_mesh((inputs / "box.obj").read_bytes(), "box.obj").mesh
    refined = read_mesh((inputs / "out" / "refined.glb").read_bytes(), "refined.glb").mesh
    assert refined.faces.shape == coarse.faces.shape
    assert float((refined.vertices - coarse.vertices).abs().max()) > 1e-4


def test_a_coarse_mesh_is_subdivided_when_asked_for(inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.run_command(arguments(inputs, "--subdivide")) == 0
    counts = json.loads((inputs / "out" / "report.json").read_text())["mesh_counts"]
    assert (counts["vertices"], counts["faces"]) == (8, 12)
    assert 500 < counts["optimised_vertices"] == counts["refined_vertices"]
    refined = read_mesh((inputs / "out" / "refined.glb").read_bytes(), "refined.glb").mesh
    assert len(refined.vertices) == counts["refined_vertices"]
    assert "the mesh was subdivided, from 8 to" in capsys.readouterr().err


def test_report_holds_the_effective_options(inputs: Path) -> None:
    options = (
        "--preset",
        "paper",
        "--seed",
        "7",
        "--symmetry-normal",
        "1",
        "0",
        "0",
        "--symmetry-offset",
        "0.25",
    )
    assert run.run_command(arguments(inputs, *options)) == 0
    config = json.loads((inputs / "out" / "report.json").read_text())["config"]
    assert (config["seed"], config["symmetry_normal"], config["symmetry_offset"]) == (7, [1, 0, 0], 0.25)
    assert [stage["iterations"] for stage in config["stages"]] == [3]


def test_same_seed_gives_the_same_bytes(inputs: Path) -> None:
    def refined(seed: str) -> bytes:
        assert (
            run.run_command(arguments(inputs, "--preset", "paper", "--iterations", "9", "--seed", seed)) == 0
        )
        return (inputs / "out" / "refined.glb").read_bytes()

    first = refined("1")
    assert refined("1") == first
    assert refined("2") != first


def events_of(lines: Sequence[str]) -> list[Event]:
    """The contract's events, and nothing beside them."""
    events = [Event.model_validate_json(line) for line in lines]
    assert [json.loads(event.model_dump_json(exclude_none=True)) for event in events] == [
        json.loads(line) for line in lines
    ]
    assert [event.sequence for event in events] == list(range(1, len(events) + 1))
    return events


def test_json_is_that_of_refine_submit(inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.run_command(arguments(inputs, "--json", "--seed", "7")) == 0
    printed, shown = capsys.readouterr()
    assert shown == ""
    *lines, last = printed.splitlines()
    started, *progress, completed = events_of(lines)
    assert (started.type, started.state) == (EventType.STATE, State.RUNNING)
    assert {event.type for event in progress} == {EventType.PROGRESS}
    assert progress[-1].progress is not None
    assert (progress[-1].progress.iteration, progress[-1].progress.percent) == (3, 100)
    assert progress[-1].progress.losses["total"] > 0
    refinement = completed.refinement
    assert refinement is not None
    assert (refinement.id, refinement.state) == ("box.obj", State.SUCCEEDED)
    assert (refinement.options.seed, refinement.options.iterations) == (7, 3)
    assert refinement.silhouette_iou is not None
    assert sorted(artifact.name for artifact in refinement.artifacts) == ARTIFACTS
    for artifact in refinement.artifacts:
        data = (inputs / "out" / artifact.name).read_bytes()
        assert (artifact.size_bytes, artifact.sha256) == (len(data), hashlib.sha256(data).hexdigest())
    files = {artifact.name: str(inputs / "out" / artifact.name) for artifact in refinement.artifacts}
    assert json.loads(last) == {"type": "artifacts", "artifacts": files}


def test_json_of_a_failed_run_ends_with_its_error(
    inputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverge(*_: object) -> NoReturn:
        raise Diverged("expected a finite loss, got nan")

    monkeypatch.setattr(Inputs, "refine", diverge)
    assert run.run_command(arguments(inputs, "--json")) == 1
    printed, shown = capsys.readouterr()
    _, completed = events_of(printed.splitlines())
    assert completed.refinement is not None
    assert completed.refinement.state is State.FAILED
    assert completed.refinement.error is not None
    assert completed.refinement.error.reason == "DIVERGED"
    assert shown == "error: DIVERGED: expected a finite loss, got nan\n"


def test_an_existing_folder_gets_the_new_artifacts(inputs: Path) -> None:
    (inputs / "out").mkdir()
    (inputs / "out" / "notes.txt").write_text("mine")
    (inputs / "out" / "refined.glb").write_text("old")
    assert run.run_command(arguments(inputs)) == 0
    assert files(inputs / "out") == sorted([*ARTIFACTS, "notes.txt"])
    assert (inputs / "out" / "refined.glb").read_bytes().startswith(b"glTF")


def test_a_bar_on_a_terminal(inputs: Path) -> None:
    master, slave = pty.openpty()
    program = (
        "import sys; from refine_engine.commands.run import run_command; sys.exit(run_command(sys.argv[1:]))"
    )
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "120"}
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments(inputs)],
        stdout=subprocess.DEVNULL, stderr=slave, env=environment,
    ) as process:  # fmt: skip
        os.close(slave)
        shown = b""
        try:
            while chunk := os.read(master, 65536):
                shown += chunk
        except OSError:  # Linux reports the closed terminal as an error, macOS as the end
            pass
    os.close(master)
    assert process.returncode == 0
    assert b"3/3" in shown
    assert b"2D IoU" in shown


def spoil_mesh(inputs: Path) -> list[str]:
    (inputs / "box.obj").write_text("v 0 0 0\n")
    return arguments(inputs)


def spoil_camera(inputs: Path) -> list[str]:
    (inputs / "camera.json").write_text('{"type": "look_at", "azimut": 3}')
    return arguments(inputs)


def spoil_silhouette(inputs: Path) -> list[str]:
    Image.new("L", (64, 64)).save(inputs / "silhouette.png")
    return arguments(inputs)


def take_the_output(inputs: Path) -> list[str]:
    (inputs / "taken").write_text("a file")
    return arguments(inputs, "-o", str(inputs / "taken" / "out"))


def look_away(inputs: Path) -> list[str]:
    away = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -2], [0, 0, 0, 1]]
    camera = {"type": "matrix", "convention": "opencv", "world_to_camera": away, "fov_y_degrees": 60}
    (inputs / "camera.json").write_text(json.dumps(camera))
    return arguments(inputs)


def lose_the_mesh(inputs: Path) -> list[str]:
    (inputs / "box.obj").unlink()
    return arguments(inputs)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (spoil_mesh, "MESH_INVALID"),
        (spoil_camera, "CAMERA_INVALID"),
        (spoil_silhouette, "SILHOUETTE_INVALID"),
        (look_away, "OBJECT_OUT_OF_VIEW"),
        (take_the_output, "OPTIONS_INVALID"),
        (lose_the_mesh, "INPUT_INVALID"),
        (lambda inputs: arguments(inputs, "--preset", "papr"), "INPUT_INVALID"),
        (lambda inputs: arguments(inputs, "--iterations", "0"), "OPTIONS_INVALID"),
        (lambda inputs: arguments(inputs, "--threads", "0"), "OPTIONS_INVALID"),
        (lambda inputs: arguments(inputs, "--symmetry-normal", "0", "0", "0"), "OPTIONS_INVALID"),
        (lambda inputs: arguments(inputs)[:1], "INPUT_INVALID"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    spoil: Callable[[Path], Sequence[str]], reason: str, inputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = spoil(inputs)
    before = files(inputs)
    assert run.run_command(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {reason}: ")
    assert files(inputs) == before


# A colour that is NaN does not make a mesh useless, and points become one: these are refined.
REFINED = {SHARED / "inputs" / "bad" / name for name in ("nancolor.obj", "points_emptyface.ply")}


@pytest.mark.parametrize(
    "path",
    sorted(set((SHARED / "inputs" / "bad").glob("*")) - REFINED)
    or [pytest.param(None, marks=pytest.mark.skip(reason="the shared malformed inputs are not here"))],
    ids=lambda path: path and path.name,
)
def test_malformed_meshes(path: Path, inputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = [str(path), *arguments(inputs)[1:]]
    assert run.run_command(argv) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(("error: MESH_INVALID: ", "error: FORMAT_UNSUPPORTED: "))
    assert not (inputs / "out").exists()


def test_a_bug_is_one_line_too(
    inputs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> NoReturn:
        raise ZeroDivisionError("nothing to\ndivide by")

    monkeypatch.setattr(Inputs, "refine", broken)
    assert run.run_command(arguments(inputs)) == 1
    *before, line = capsys.readouterr().err.splitlines()
    assert before == ["running", "failed"]
    assert line.startswith("error: INTERNAL: ZeroDivisionError: nothing to divide by (test_run_command.py:")
    assert not (inputs / "out").exists()


def test_an_interrupt_leaves_nothing(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    before = files(inputs)
    monkeypatch.setattr(Inputs, "refine", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.run_command(arguments(inputs))
    assert files(inputs) == before


def test_several_views_and_unknown_pixels(inputs: Path, tmp_path: Path) -> None:
    """The same silhouette twice, once as JPEG; the right half of the second is unknown."""
    with Image.open(inputs / "silhouette.png") as image:
        image.save(tmp_path / "second.jpg", quality=95)
    pixels = np.zeros((64, 64), np.uint8)
    pixels[:, 32:] = 255
    Image.fromarray(pixels).save(tmp_path / "hand.png")
    camera = str(inputs / "camera.json")
    views = ["--view", str(tmp_path / "second.jpg"), camera, str(tmp_path / "hand.png")]
    arguments = [str(inputs / name) for name in ("box.obj", "silhouette.png")]
    out = tmp_path / "out"
    assert (
        run.run_command(
            [*arguments, "--camera", camera, *views, "--iterations", "2", "-o", str(out), "--threads", "1"]
        )
        == 0
    )
    report = json.loads((out / "report.json").read_text())
    assert [view["known"] for view in report["views"]] == [1.0, 0.5]
    assert len(report["views"]) == 2


def test_a_bad_camera_of_a_view_is_told_where_it_is(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.json").write_text(json.dumps({"type": "look_at"}))
    files = [str(inputs / name) for name in ("box.obj", "silhouette.png")]
    view = ["--view", files[1], str(tmp_path / "bad.json")]
    camera = ["--camera", str(inputs / "camera.json")]
    assert run.run_command([*files, *camera, *view, "-o", str(tmp_path / "out")]) == 2
    assert "CAMERA_INVALID: /views/0/camera/azimuth_degrees: expected" in capsys.readouterr().err
