"""`refine bench` from files to tables and report: it goes on past what is broken, and continues."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from refine_bench.cases import Case, Scene, mesh_of
from refine_bench.command import bench_command
from refine_bench.outcome import Outcome
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.values import Camera

PLUGIN = '''
from refine_engine.values import Mesh

calls = []

def shrink(mesh, silhouette, camera):
    """Undoes the error of the test's coarse meshes, which are 25 % too large."""
    calls.append(silhouette.shape)
    return Mesh(mesh.vertices / 1.25, mesh.faces)

def keep(mesh, silhouette, camera):
    return mesh

def crash(mesh, silhouette, camera):
    raise ZeroDivisionError("of the plug-in")
'''


@pytest.fixture
def cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three cases of one's own, and a plug-in beside them that can be imported."""
    (tmp_path / "bench_plugin.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    shape = trimesh.creation.box((0.5, 0.3, 0.4)).subdivide().subdivide()
    spec = {"azimuth_degrees": 30.0, "elevation_degrees": 20.0, "distance": 1.4, "fov_y_degrees": 60.0}
    mask = hard_silhouette(mesh_of(shape), Camera.look_at(**spec, width=96, height=96))
    for name in ("first", "second", "third"):
        folder = tmp_path / "cases" / name
        folder.mkdir(parents=True)
        shape.export(folder / "gt.obj")
        larger = shape.copy()
        larger.vertices = larger.vertices * 1.25
        larger.export(folder / "coarse.obj")
        Image.fromarray(mask.numpy().astype(np.uint8) * 255).save(folder / "silhouette.png")
        (folder / "camera.json").write_text(json.dumps({"type": "look_at", **spec}))
    return tmp_path / "cases"


def bench(cases: Path, *arguments: str) -> int:
    return bench_command(
        ["folder", str(cases), "--threads", "1", "-o", str(cases.parent / "out"), *arguments]
    )


def size(picture: Path) -> tuple[int, int]:
    with Image.open(picture) as image:
        return image.size


def lines(cases: Path) -> list[dict[str, object]]:
    text = (cases.parent / "out" / "results.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


def test_a_missing_coarse_mesh_is_named_and_the_rest_is_done_then_continued(
    cases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    coarse = cases / "second" / "coarse.obj"
    kept = coarse.read_bytes()
    coarse.unlink()
    assert bench(cases, "--method", "bench_plugin:shrink") == 1
    printed = capsys.readouterr()
    assert "failed: second: expected" in printed.err
    assert "coarse.obj" in printed.err
    assert [(line["case"], line["status"]) for line in lines(cases)] == [
        ("first", "done"), ("second", "failed"), ("third", "done"),
    ]  # fmt: skip
    coarse.write_bytes(kept)
    assert bench(cases, "--method", "bench_plugin:shrink") == 0
    assert "2 results are there already; 1 are left" in capsys.readouterr().err
    assert [line["case"] for line in lines(cases)] == ["first", "second", "third", "second"]


def test_tables_figure_and_report_say_what_was_measured(
    cases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench(cases, "--method", "bench_plugin:shrink", "--limit", "2") == 0
    out = cases.parent / "out"
    tables = (out / "tables.md").read_text()
    assert tables in capsys.readouterr().out
    row = next(line for line in tables.splitlines() if line.startswith("| **mean**"))
    before, after = re.findall(r"\*\*(0\.\d+) -> (1\.000|0\.\d+) ", row)[-1]  # 2D IoU
    assert float(before) < 0.8 < 0.99 < float(after)
    assert "0 of 2" in tables
    assert size(out / "figure.png")[0] > 800
    report = (out / "report.html").read_text()
    assert report.count("<section class='case'>") == 2
    assert report.count("data:image/png;base64,") == 3
    assert not re.search(r"(src|href)='(?!data:)", report)
    assert size(out / "pictures" / "bench_plugin.shrink" / "first_0.png") == (6 * 168, 2 * 168)


def test_a_plugin_that_crashes_costs_its_own_results_only(
    cases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    methods = ["--method", "bench_plugin:crash", "--method", "bench_plugin:shrink"]
    assert bench(cases, *methods, "--case", "first") == 1
    assert "ZeroDivisionError: of the plug-in" in capsys.readouterr().err
    assert [line["status"] for line in lines(cases)] == ["failed", "done"]


def test_two_seeds_of_two_methods_are_four_results(cases: Path) -> None:
    methods = ["--method", "bench_plugin:shrink", "--method", "bench_plugin:keep"]
    assert bench(cases, *methods, "--case", "third", "--seeds", "2") == 0
    tables = (cases.parent / "out" / "tables.md").read_text()
    assert "## Methods side by side" in tables
    assert "## Spread over seeds" in tables
    assert len(lines(cases)) == 4


def test_points_as_truth_are_scored_and_a_variant_has_its_own_results(
    cases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = trimesh.load(cases / "first" / "gt.obj", process=False)
    np.savetxt(cases / "first" / "gt.xyz", trimesh.sample.sample_surface(truth, 3000, seed=0)[0])
    (cases / "first" / "gt.obj").unlink()
    assert bench(cases, "--method", "bench_plugin:shrink", "--case", "first") == 0
    (line,) = lines(cases)
    before, after = (line[when] for when in ("before", "after"))
    assert isinstance(before, dict)
    assert isinstance(after, dict)
    assert after["chamfer_l2"] < 0.2 * before["chamfer_l2"]
    assert after["volumetric_iou"] is None
    keep = ["--method", "bench_plugin:keep", "--case", "second"]
    assert bench(cases, *keep, "--variant", "truth") == 2  # other results lie in that folder
    assert "with variant = None instead of truth" in capsys.readouterr().err
    other = ["folder", str(cases), "--threads", "1", "-o", str(cases.parent / "truth")]
    assert bench_command([*other, *keep, "--variant", "truth"]) == 0
    (kept,) = (
        json.loads(text) for text in (cases.parent / "truth" / "results.jsonl").read_text().splitlines()
    )
    assert kept["after"]["silhouette_iou"] == 1.0
    assert kept["measures"]["motion"] == 0.0


def test_the_plane_is_told_only_when_asked(cases: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = []

    def method(case: Case, scene: Scene, seed: int) -> Outcome:
        told.append(case.plane_told)
        return Outcome(scene.coarse, 0.0)

    monkeypatch.setattr("refine_bench.command.make_method", lambda name, config: method)
    assert bench(cases, "--case", "first") == 0
    out = str(cases.parent / "told")
    assert bench_command(["folder", str(cases), "--case", "first", "--tell-plane", "-o", out]) == 0
    assert told == [False, True]


def test_a_set_can_be_written_as_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--level", "none", "--count", "1", "--set-seed", "4", "--write", str(tmp_path / "upstream")]
    assert bench_command(["upstream", *arguments]) == 0
    (name,) = (folder.name for folder in (tmp_path / "upstream" / "none").iterdir())
    assert name == "airplane_0_none"
    assert capsys.readouterr().out.strip().endswith(name)
    files = {path.name for path in (tmp_path / "upstream" / "none" / name).iterdir()}
    wanted = {"coarse.obj", "gt.obj", "silhouette.png", "camera.json", "image.png", "symmetry.json"}
    assert files == wanted


@pytest.mark.slow
def test_the_engine_refines_a_case_of_the_synthetic_set(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["--subset", "small", "--preset", "fast", "--case", "speaker", "--threads", "1"]
    assert bench_command(["synthetic", *arguments, "-o", str(out)]) == 0
    (line,) = (json.loads(text) for text in (out / "results.jsonl").read_text().splitlines())
    assert (line["category"], line["method"]) == ("speaker", "refine")
    assert line["after"]["silhouette_iou"] > line["before"]["silhouette_iou"] - 0.05
    assert len(line["loss_curve"]) > 10


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["folder", "nowhere"], "expected cases in the folder nowhere, which does not exist"),
        (["pix3d", "nowhere", "--coarse", "x"], "expected Pix3D in the folder nowhere"),
        (["synthetic", "--method", "no_such"], "expected a method among refine"),
        (["synthetic", "--case", "no such case"], "expected at least one case"),
        (["synthetic", "--server", "http://127.0.0.1:9"], "expected a server that answers at"),
    ],
)
def test_what_cannot_start_is_one_line_and_exit_code_2(
    argv: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert bench_command(argv) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: SET_INVALID: ")
    assert message in error
    assert not (tmp_path / "out").exists()
