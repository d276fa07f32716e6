"""The numbers of the method."""

import math
from dataclasses import fields

import pytest

from refine_engine.errors import OptionsInvalid
from refine_engine.method.config import Opening, ProportionFit, RefineConfig, Stage, Weights
from refine_engine.method.presets import PRESETS, make_config

PAPER = {  # arXiv 2108.09911, sections 3 and 4
    "proportions": None,
    "stages": (Stage(iterations=400, render_size=224, softness=1e-4),),
    "weights": Weights(
        silhouette=10,
        image_symmetry=80,
        vertex_symmetry=20,
        displacement=100,
        normal_consistency=10,
        laplacian=10,
    ),
    "confidence_cost": 0.0005,
    "learning_rate": 7e-5,
    "encoder_size": 224,
    "train_encoder": True,
    "symmetry_azimuths_degrees": (15, 45, 75),
    "symmetry_elevations_degrees": (-45, 45),
    "symmetry_distance": 1.9,
    "symmetry_fov_degrees": 60,
    "symmetry": "plane",
    "symmetry_normal": (0, 0, 1),
    "symmetry_offset": 0.0,
    "agreement": None,
    "learn_confidence": True,
    "opening": Opening(),  # part of the whole-mesh fit, which there is none of
    "topology": "fixed",
    "crop": False,
    "pyramid": False,
    "unexplained_depth": None,
    "regularise_change": False,
    "seed": 0,
}


def test_paper_is_the_published_table() -> None:
    config = RefineConfig.paper()
    assert {field.name: getattr(config, field.name) for field in fields(config)} == PAPER


def test_presets_cost_what_they_promise() -> None:
    """In pixels rendered: the default at most what the paper costs, fast a quarter."""

    def pixels(config: RefineConfig) -> int:
        fit = config.proportions or ProportionFit(iterations=0)
        rendered = sum(13 * stage.iterations * stage.render_size**2 for stage in config.stages)
        return rendered + fit.iterations * fit.render_size**2

    paper = pixels(RefineConfig.paper())
    assert pixels(RefineConfig()) <= paper
    assert pixels(RefineConfig.fast()) <= paper / 4


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_render_large_enough_for_the_pyramid(preset: str) -> None:
    config = make_config(preset)
    assert config.iterations == sum(stage.iterations for stage in config.stages)
    assert config.proportions is None or config.proportions.render_size >= 32  # six levels


@pytest.mark.parametrize("normal", [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 0.0)])
def test_a_normal_without_direction(normal: tuple[float, float, float]) -> None:
    with pytest.raises(OptionsInvalid, match="expected a symmetry_normal with a direction, got"):
        make_config(symmetry_normal=normal)


@pytest.mark.parametrize("offset", [math.nan, math.inf])
def test_an_offset_that_is_no_place(offset: float) -> None:
    with pytest.raises(OptionsInvalid, match=f"expected a finite symmetry_offset, got {offset}"):
        make_config(symmetry_offset=offset)


@pytest.mark.parametrize("stages", [(), (Stage(0, 224, 1e-4),), (Stage(10, 112, 1e-3), Stage(-1, 224, 1e-4))])
def test_stages_that_do_nothing(stages: tuple[Stage, ...]) -> None:
    with pytest.raises(OptionsInvalid, match="expected stages of at least one iteration"):
        RefineConfig(stages=stages)
