"""What a user may choose about a run, and the RefineConfig that it makes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

from ..errors import OptionsInvalid
from .config import RefineConfig, Stage, Symmetry, Topology

PRESETS: Mapping[str, Callable[[], RefineConfig]] = {
    "paper": RefineConfig.paper,
    "default": RefineConfig,
    "fast": RefineConfig.fast,
}
MAX_ITERATIONS = 10_000
CAMERA_PRIOR = 1.0  # suits a few degrees of error, see ProportionFit


def make_config(
    preset: str = "default",
    iterations: int | None = None,
    seed: int = 0,
    symmetry: Symmetry | None = None,
    symmetry_normal: tuple[float, float, float] | None = None,
    symmetry_offset: float | None = None,
    topology: Topology | None = None,
    correct_camera: bool = False,
) -> RefineConfig:
    """The preset with the given choices; None leaves the preset's. A plane that is given is not searched for.

    Raises OptionsInvalid.
    """
    if preset not in PRESETS:
        raise OptionsInvalid(f"expected preset to be one of {', '.join(PRESETS)}, got {preset!r:.60}")
    config = replace(PRESETS[preset](), seed=seed)
    if symmetry_normal is not None or symmetry_offset is not None:
        if symmetry not in (None, "plane"):
            raise OptionsInvalid(f"expected no plane with symmetry {symmetry}, got one; leave symmetry out")
        symmetry = "plane"
    if symmetry is not None:
        config = replace(config, symmetry=symmetry)
    if symmetry_normal is not None:
        config = replace(config, symmetry_normal=symmetry_normal)
    if symmetry_offset is not None:
        config = replace(config, symmetry_offset=symmetry_offset)
    if topology is not None:
        config = replace(config, topology=topology)
    if correct_camera:
        if config.proportions is None:
            raise OptionsInvalid(f"expected no correct_camera with preset {preset}, whose cameras are exact")
        config = replace(config, proportions=replace(config.proportions, camera_prior=CAMERA_PRIOR))
    if iterations is not None:
        config = replace(config, stages=shorten(config.stages, iterations))
    return config


def shorten(stages: tuple[Stage, ...], iterations: int) -> tuple[Stage, ...]:
    """The stages with their shares of another number of iterations; one whose share is none is left out."""
    if not 1 <= iterations <= MAX_ITERATIONS:
        raise OptionsInvalid(f"expected 1 to {MAX_ITERATIONS} iterations, got {iterations}")
    total = sum(stage.iterations for stage in stages)
    ends = [0]
    for stage in stages:
        ends.append(ends[-1] + stage.iterations)
    shares = [after * iterations // total - before * iterations // total for before, after in pairwise(ends)]
    return tuple(
        replace(stage, iterations=share) for stage, share in zip(stages, shares, strict=True) if share
    )
