"""The example from image to refined mesh runs as it stands, here with fewer iterations."""

import json
import runpy
from functools import partial
from pathlib import Path

import pytest

import refine_engine
from refine_engine import make_config, read_mesh

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "network_refine.py"


def test_from_an_image_to_a_refined_mesh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(refine_engine, "make_config", partial(make_config, iterations=3))
    monkeypatch.setattr("sys.argv", [str(EXAMPLE), "bench", str(tmp_path)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    folder = tmp_path / "strong" / "bench_0_strong"
    read_mesh((folder / "refined.glb").read_bytes(), "refined.glb")
    iou = json.loads((folder / "report.json").read_text())["silhouette_iou"]
    assert iou["after"] > iou["before"]
    printed = capsys.readouterr().out
    assert printed.index("coarse ") < printed.index("refined ") < printed.index("preview.png")
