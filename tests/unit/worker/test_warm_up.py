"""The tiny refinements with which an engine process starts."""

from pathlib import Path
from typing import Any

import pytest
import torch

from refine_engine.artifacts.make import make_artifacts
from refine_worker.engine import warm_up


@pytest.mark.parametrize(("preset", "trains_encoder"), [("default", False), ("paper", True)])
def test_every_preset_runs_to_its_artifacts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str, trains_encoder: bool
) -> None:
    made: list[Any] = []
    monkeypatch.setattr(
        "refine_worker.engine.warm_up.make_artifacts",
        lambda *arguments: made.append((arguments[-1], make_artifacts(*arguments))),
    )
    warm_up.warm_up(torch.device("cpu"), preset)
    ((config, artifacts),) = made
    assert config.train_encoder == trains_encoder
    assert "refined.glb" in artifacts


def test_a_card_is_warmed_for_the_encoder_too() -> None:
    assert warm_up.presets_to_warm(torch.device("cpu")) == ["default"]
    assert warm_up.presets_to_warm(torch.device("cuda")) == ["default", "paper"]
