"""What a user may choose, and the configuration that it makes."""

import pytest

from refine_engine.errors import OptionsInvalid
from refine_engine.method.config import RefineConfig, Stage
from refine_engine.method.presets import make_config, shorten

STAGES = (Stage(100, 56, 3e-3), Stage(100, 112, 6e-4), Stage(200, 224, 1e-4))


def test_without_choices_it_is_the_default_preset() -> None:
    assert make_config() == RefineConfig()
    assert make_config("paper") == RefineConfig.paper()


def test_the_offset_of_a_preset_stays_unless_given() -> None:
    assert make_config("paper", seed=3).symmetry_offset == 0.0
    assert make_config("paper", symmetry_offset=0.5).symmetry_offset == 0.5


@pytest.mark.parametrize(
    ("iterations", "shares"),
    [
        (400, [100, 100, 200]),
        (20, [5, 5, 10]),
        (6, [1, 2, 3]),
        (2, [1, 1]),
        (1, [1]),
        (4000, [1000, 1000, 2000]),
    ],
)
def test_stages_keep_their_shares(iterations: int, shares: list[int]) -> None:
    stages = shorten(STAGES, iterations)
    assert [stage.iterations for stage in stages] == shares
    assert stages[-1].render_size == 224


@pytest.mark.parametrize("iterations", [0, -1, 10_001])
def test_iterations_out_of_range(iterations: int) -> None:
    with pytest.raises(OptionsInvalid, match=f"expected 1 to 10000 iterations, got {iterations}"):
        make_config(iterations=iterations)


def test_unknown_preset() -> None:
    with pytest.raises(OptionsInvalid, match="expected preset to be one of paper, default"):
        make_config("papr")
