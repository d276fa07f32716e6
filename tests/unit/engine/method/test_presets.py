"""What a user may choose, and the configuration that it makes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_engine.errors import OptionsInvalid
from refine_engine.method.config import RefineConfig, Stage
from refine_engine.method.presets import MAX_ITERATIONS, make_config, shorten

STAGES = (Stage(100, 56, 3e-3), Stage(100, 112, 6e-4), Stage(200, 224, 1e-4))


def test_without_choices_it_is_the_default_preset() -> None:
    assert make_config() == RefineConfig()
    assert make_config("paper") == RefineConfig.paper()


def test_the_offset_of_a_preset_stays_unless_given() -> None:
    assert make_config("paper", seed=3).symmetry_offset == 0.0
    assert make_config("paper", symmetry_offset=0.5).symmetry_offset == 0.5


def test_a_plane_that_is_given_is_not_searched_for() -> None:
    assert make_config().symmetry == "auto"
    assert make_config(symmetry_offset=0.5).symmetry == "plane"
    assert make_config(symmetry_normal=(1.0, 0.0, 0.0)).symmetry == "plane"


@pytest.mark.parametrize(
    ("iterations", "shares"),
    [
        (400, [100, 100, 200]),
        (20, [5, 5, 10]),
        (6, [1, 2, 3]),
        (2, [1, 1]),
        (1, [1]),
        (4000, [1000, 1000, 2000]),
        (10_000, [2500, 2500, 5000]),
    ],
)
def test_stages_keep_their_shares(iterations: int, shares: list[int]) -> None:
    stages = shorten(STAGES, iterations)
    assert [stage.iterations for stage in stages] == shares
    assert stages[-1].render_size == 224


@given(st.lists(st.integers(1, 1600), min_size=1, max_size=6), st.integers(1, MAX_ITERATIONS))
def test_shortened_stages_are_a_share_of_each_and_all_of_the_iterations(
    lengths: list[int], iterations: int
) -> None:
    stages = tuple(Stage(length, 32 + number, 1e-3) for number, length in enumerate(lengths))
    shortened = shorten(stages, iterations)
    assert sum(stage.iterations for stage in shortened) == iterations
    assert shortened[-1].render_size == stages[-1].render_size  # the result is taken from the last stage
    share = {stage.render_size: stage.iterations for stage in shortened}
    assert list(share) == sorted(share)
    assert min(share.values()) > 0
    for stage in stages:
        exact = stage.iterations * iterations / sum(lengths)
        assert abs(share.get(stage.render_size, 0) - exact) < 1
    assert shorten(stages, sum(lengths)) == stages


@pytest.mark.parametrize("iterations", [0, -1, 10_001])
def test_iterations_out_of_range(iterations: int) -> None:
    with pytest.raises(OptionsInvalid, match=f"expected 1 to 10000 iterations, got {iterations}"):
        make_config(iterations=iterations)


def test_unknown_preset() -> None:
    with pytest.raises(OptionsInvalid, match="expected preset to be one of paper, default"):
        make_config("papr")
