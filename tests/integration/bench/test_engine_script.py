"""The engine's benchmark: what it counts is right, its scores are the engine's metrics, its parts run."""

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from refine_bench import measure, quality
from refine_engine.kernels import oracle
from refine_engine.method.config import RefineConfig, Stage
from refine_engine.scores.scores import evaluate

ROOT = Path(__file__).resolve().parents[3]
AIRPLANE = ROOT / "examples" / "samples" / "airplane"


def test_pairs_are_those_of_the_oracle() -> None:
    screen = torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(0)) * 20
    faces = torch.arange(12).reshape(4, 3)
    side, softness = 20, 1e-3
    p = oracle.pixel_centres(side, side, screen).reshape(-1, 2)
    softness_px = softness * side**2 / 4
    reach = math.sqrt(oracle.CUTOFF * softness_px)
    x = [oracle.signed_squared_distance(p, view[faces][..., :2], reach) / softness_px for view in screen]
    expected = sum(int((of_view > -oracle.CUTOFF).sum()) for of_view in x)
    assert expected > 100
    assert measure.contributing_pairs(screen, faces, side, softness) == expected


def test_parts_of_an_iteration_cover_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def once(work: Callable[[], object]) -> float:
        work()
        return 1.0

    monkeypatch.setattr(measure, "cpu_seconds", once)
    inputs = measure.read_case(AIRPLANE)
    config = RefineConfig(proportions=None, stages=(Stage(3, 32, 1e-3),), encoder_size=32, train_encoder=True)
    fit = measure.start(inputs.mesh_file.mesh, inputs.views[0], config)
    before = fit.network.displacement.weight.detach().clone()
    parts = measure.stage_seconds(fit)
    assert next(iter(parts)) == "encoder"
    assert list(parts)[-1] == "iteration"
    assert not torch.equal(before, fit.network.displacement.weight)  # the optimiser was one of them
    assert measure.network_flop(fit) > 2 * len(fit.coarse) * 128 * 256 * 8 * 3  # the graph convolutions alone


def test_a_case_is_refined_once_and_scored_as_the_engine_does(tmp_path: Path) -> None:
    config = RefineConfig(proportions=None, stages=(Stage(2, 32, 1e-3),), encoder_size=32)
    quality.refine_case(AIRPLANE, config, tmp_path / "airplane")
    refined = tmp_path / "airplane" / "refined.glb"
    written = refined.stat().st_mtime_ns
    quality.refine_case(AIRPLANE, config, tmp_path / "airplane")
    assert refined.stat().st_mtime_ns == written

    score = quality.score_case(AIRPLANE, refined)
    inputs = measure.read_case(AIRPLANE)
    truth = measure.read_mesh_file(AIRPLANE / "gt.obj")
    expected = evaluate(inputs.mesh_file.mesh, truth, view=inputs.views[0])
    assert score.chamfer is not None
    assert score.f is not None
    assert score.chamfer[0] == pytest.approx(expected.chamfer_l2)
    assert score.f[0] == pytest.approx(expected.f_score)
    assert score.iou[0] == pytest.approx(expected.silhouette_iou)


def test_a_summary_is_of_ratios() -> None:
    one = quality.Score("one", (0.5, 0.7), (8.0, 2.0), (50.0, 60.0))
    two = quality.Score("two", (0.7, 0.9), (2.0, 2.0), (40.0, 60.0))
    unknown = quality.Score("unknown", (0.3, 0.5), None, None)
    summary = quality.Summary.of([one, two, unknown])
    assert summary.chamfer_ratio == pytest.approx(np.sqrt(0.25))
    assert (summary.worst_case, summary.worst_ratio) == ("two", 1.0)
    assert summary.f_gain == pytest.approx(15.0)
    assert summary.iou_before == pytest.approx(0.5)
    assert summary.iou_after == pytest.approx(0.7)


def test_one_size_as_a_command() -> None:
    script = ROOT / "benchmarks" / "engine.py"
    command = [sys.executable, str(script), "iteration", "--vertices", "100", "--side", "32"]
    numbers = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert all(value > 0 for value in numbers.values())
    assert set(numbers) == {"default, ms", "paper, ms", "memory, GB"}
