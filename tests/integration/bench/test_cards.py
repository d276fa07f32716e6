"""benchmarks/cards.py: its measuring functions run on the CPU here. No time is asserted."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from refine_engine import RefineConfig
from refine_engine.method.config import Stage

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "cards.py"
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def cards() -> ModuleType:
    spec = importlib.util.spec_from_file_location("cards", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["cards"] = module
    spec.loader.exec_module(module)
    return module


def small(iterations: int = 2, train_encoder: bool = True) -> RefineConfig:
    stages = (Stage(iterations, 32, 3e-3),)
    return RefineConfig(
        proportions=None, stages=stages, encoder_size=32, train_encoder=train_encoder, agreement=None
    )


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_a_card_it_says_so() -> None:
    result = subprocess.run([sys.executable, str(SCRIPT)], capture_output=True, text=True)
    assert result.returncode == 2
    assert "expected a CUDA device, got none" in result.stderr
    assert result.stdout == ""


def test_arguments(cards: ModuleType) -> None:
    options = cards.parse(["--preset", "fast", "--instances", "1", "3", "--device", "cuda:1"])
    assert (options.preset, options.instances, options.device) == ("fast", [1, 3], torch.device("cuda:1"))
    assert (options.sample / "coarse.obj").exists()
    with pytest.raises(SystemExit):
        cards.parse(["--preset", "slow"])


def test_presets_and_parts_are_measured(cards: ModuleType) -> None:
    case = cards.load(cards.SAMPLES / "airplane", CPU)
    (row,) = cards.time_presets(case, CPU, {"small": small()}, 2)
    assert row[0] == "small"
    assert all(float(number) > 0 for number in row[1:5])
    for train_encoder in (False, True):
        parts = [row[0] for row in cards.time_parts(case, CPU, small(train_encoder=train_encoder), 1)]
        assert ("encoder" in parts) == train_encoder
        assert parts[-1] == "whole iteration"
        assert "image symmetry" not in parts
    paper = replace(RefineConfig.paper(), stages=(Stage(2, 32, 3e-3),), encoder_size=32)
    parts = [row[0] for row in cards.time_parts(case, CPU, paper, 1)]
    assert {"encoder", "hard renders", "image symmetry", "vertex symmetry"} <= set(parts)


def test_streams_race(cards: ModuleType) -> None:
    case = cards.load(cards.SAMPLES / "airplane", CPU)
    assert len(cards.race_streams(case, CPU, small(1), 2, 1)) == 2


def test_a_failure_in_a_race_is_raised(cards: ModuleType) -> None:
    case = cards.load(cards.SAMPLES / "airplane", CPU)
    with pytest.raises(AttributeError):
        cards.race_streams(case, CPU, None, 2, 1)


def test_a_process_that_fails_ends_the_race(cards: ModuleType) -> None:
    with pytest.raises(SystemExit, match="before it was ready"):
        cards.race_processes(["--preset", "slow"], 2)


def test_race_table(cards: ModuleType) -> None:
    races = {1: [cards.Run(10.0, 300.0)], 4: [cards.Run(16.0, 310.0)] * 3 + [cards.Run(15.0, 290.0)]}
    rows = cards.race_rows("streams", races, 5)
    assert rows == [
        ["streams", "1", "30.0", "1.00", "2.000", "300"],
        ["streams", "4", "75.0", "2.50", "3.200", "310"],
    ]
    assert cards.table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_cancellation_is_measured_from_its_request(cards: ModuleType) -> None:
    case = cards.load(cards.SAMPLES / "airplane", CPU)
    assert cards.cancellation_ms(case, small(10_000), 0.05) > 0
