"""`refine eval` on the sample: what it prints and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from refine_engine.commands.evaluate import eval_command

SAMPLE = Path(__file__).resolve().parents[2] / "examples" / "samples" / "car"
COARSE, TRUTH = str(SAMPLE / "coarse.obj"), str(SAMPLE / "gt.obj")
VIEW = ["--camera", str(SAMPLE / "camera.json"), "--silhouette", str(SAMPLE / "silhouette.png")]


def test_json_holds_every_metric(capsys: pytest.CaptureFixture[str]) -> None:
    assert eval_command([TRUTH, TRUTH, "--coarse", COARSE, *VIEW, "--seeds", "1", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["normalisation"], result["seeds"]) == ("shared", 1)
    coarse, predicted = result["coarse"], result["predicted"]
    assert coarse.keys() == {"emd", "chamfer_l2", "f_score", "volumetric_iou", "silhouette_iou"}
    assert predicted["volumetric_iou"] == 1.0
    assert predicted["silhouette_iou"] > 0.98
    for smaller in ("emd", "chamfer_l2"):
        assert predicted[smaller] < coarse[smaller]
    for larger in ("f_score", "volumetric_iou", "silhouette_iou"):
        assert predicted[larger] > coarse[larger]


def test_table_leaves_out_what_was_not_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert eval_command([COARSE, TRUTH, "--seeds", "1", "--normalisation", "own"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:16].strip() for line in lines] == ["", "EMD", "Chamfer-l2", "F-score", "volumetric IoU"]
    assert lines[0].split() == ["predicted"]


@pytest.mark.parametrize("view", [VIEW, []])
def test_picture_shows_where_a_mesh_is_wrong(view: list[str], tmp_path: Path) -> None:
    path = tmp_path / "error.png"
    arguments = [TRUTH, TRUTH, "--coarse", COARSE, *view, "--seeds", "1", "--picture", str(path)]
    assert eval_command(arguments) == 0
    picture = np.asarray(Image.open(path)).astype(int)
    sheet = picture[:-40]  # below it is the legend
    coarse, truth = sheet.reshape(2, len(sheet) // 2, *sheet.shape[1:])
    for row, least, most in ((coarse, 50, 255), (truth, 0, 15)):
        for panel in np.split(row[30:-4], 4, axis=1):
            inside = panel[:, 4:-4]
            seen = inside[inside.min(-1) < 200]
            assert len(seen) > 2000
            assert least <= np.quantile(seen[:, 1], 0.9) <= most, (least, most)  # green rises with the error


def test_turntable_turns_once_around(tmp_path: Path) -> None:
    path = tmp_path / "turn.webp"
    arguments = [COARSE, TRUTH, "--coarse", COARSE, "--seeds", "1", "--turntable", str(path)]
    assert eval_command(arguments) == 0
    with Image.open(path) as image:
        assert (image.format, image.info["loop"]) == ("WEBP", 0)
        frames = [np.asarray(frame.convert("L")).astype(int) for frame in ImageSequence.Iterator(image)]
    assert len(frames) == 36
    coarse, predicted, truth = np.split(frames[0][30:], 3, axis=1)
    assert abs(coarse - predicted).mean() < 1  # the same mesh; the compression differs
    assert abs(coarse - truth).mean() > 2
    assert abs(frames[0] - frames[9]).mean() > 2


def test_bad_input_is_one_line_and_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty.obj"
    empty.write_bytes(b"")
    for predicted in (empty, tmp_path / "missing.obj"):
        assert eval_command([str(predicted), TRUTH]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("error: ")
        assert printed.err.count("\n") == 1


@pytest.mark.parametrize(
    ("argv", "message"),
    [(VIEW[:2], "--camera and --silhouette together"), (["--seeds", "0"], "at least 1, got '0'")],
)
def test_wrong_arguments_say_what_was_expected(
    argv: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        eval_command([COARSE, TRUTH, *argv])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err
