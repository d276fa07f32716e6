"""What the contract lets in as options, the engine can do; what it refuses, the engine refuses."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from pydantic import ValidationError

from refine_engine.contract import config_of
from refine_engine.errors import OptionsInvalid
from refine_engine.method.presets import MAX_ITERATIONS, PRESETS, make_config
from refine_jobs.share import estimated_cost_ms
from refine_proto.models import Preset, RefinementOptions, RefinementSpec, Symmetry, Topology


def test_presets_are_the_engines() -> None:
    assert list(Preset) == list(PRESETS)


@pytest.mark.parametrize("preset", Preset)
@pytest.mark.parametrize(
    "options",
    [
        {"iterations": iterations, "seed": seed, "symmetry_normal": normal, "symmetry_offset": offset}
        for iterations, seed, normal, offset in itertools.product(
            (None, 1, MAX_ITERATIONS), (0, 2**32 - 1), ([0, 0, 2e-6], [-9e29, 9e29, 9e29]), (None, -9e29)
        )
    ],
)
def test_the_engine_takes_what_the_contract_lets_in(preset: Preset, options: dict[str, Any]) -> None:
    config = config_of(RefinementOptions(preset=preset, **options))
    assert config.iterations == options["iterations"] or options["iterations"] is None
    assert (config.symmetry, config.symmetry_normal) == ("plane", tuple(options["symmetry_normal"]))


@pytest.mark.parametrize(("preset", "symmetry"), [("default", "auto"), ("fast", "auto"), ("paper", "plane")])
def test_a_plane_that_nobody_tells_is_found(preset: Preset, symmetry: str) -> None:
    assert config_of(RefinementOptions(preset=preset)).symmetry == symmetry


@pytest.mark.parametrize("preset", Preset)
def test_a_choice_counts_more_than_the_preset(preset: Preset) -> None:
    chosen = config_of(RefinementOptions(preset=preset, symmetry=Symmetry.NONE, topology=Topology.OPEN))
    assert (chosen.symmetry, chosen.topology) == ("none", "open")


def test_cameras_are_corrected_when_asked_for() -> None:
    for asked in (False, True):
        fit = config_of(RefinementOptions(correct_camera=asked)).proportions
        assert fit is not None
        assert (fit.camera_prior is not None) == asked


@pytest.mark.parametrize(
    "options",
    [
        {"iterations": 0},
        {"iterations": MAX_ITERATIONS + 1},
        {"symmetry_normal": (0.0, 0.0, 0.0)},
        {"symmetry_normal": (0.0, 1e-7, 0.0)},
        {"symmetry_normal": (1e-6, 0.0, 0.0)},
        {"symmetry_offset": float("inf")},
        {"preset": "paper", "correct_camera": True},
        {"symmetry": "none", "symmetry_normal": (0.0, 0.0, 1.0)},
        {"symmetry": "auto", "symmetry_offset": 1.0},
    ],
)
def test_both_refuse_the_same(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        RefinementOptions.model_validate(options)
    with pytest.raises(OptionsInvalid):
        make_config(**options)


@pytest.mark.parametrize("preset", Preset)
def test_a_jobs_cost_is_estimated_from_the_engines_iterations(preset: Preset) -> None:
    def cost(iterations: int | None) -> int:
        options = {"preset": preset, "iterations": iterations}
        spec = {"camera": {"type": "estimate"}, "options": options}
        return estimated_cost_ms(RefinementSpec.model_validate(spec), 20_000)

    assert cost(None) == cost(make_config(preset).iterations)
    assert cost(None) != cost(make_config(preset).iterations + 10)
