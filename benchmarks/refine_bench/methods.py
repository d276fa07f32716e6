"""Ways to refine a case: the engine with its ablations, the baselines, and plug-ins of other people.

A plug-in is one function `refine(mesh, silhouette, camera) -> mesh`: coarse `Mesh`, silhouette (H, W) float32
with 1 on the object, `Camera`; the result is a `Mesh` in the same world frame. It is named as
`package.module:refine`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module

from torch import Tensor

from refine_engine.cameras.seen import mean_silhouette_iou
from refine_engine.method.config import RefineConfig, Weights
from refine_engine.method.outcome import State, keep
from refine_engine.method.presets import PRESETS
from refine_engine.method.whole_mesh import fit_whole_mesh
from refine_engine.proxy.run import refine_any_size
from refine_engine.values import Camera, Mesh

from . import baselines
from .cases import Case, Scene, SetInvalid
from .outcome import Method, Outcome
from .white_box import white_box

Plugin = Callable[[Mesh, Tensor, Camera], Mesh]

PLAIN = "refine"
PROPORTIONS = "proportions"  # the fit of the whole mesh alone, in presets that have one
ASYMMETRIC_ONLY = "confidence_cost_1"
# What is switched off of `_all_terms`, from nothing but the silhouette to all terms (paper, ablation table).
WITHOUT: Mapping[str, tuple[str, ...]] = {
    "silhouette": (
        "displacement",
        "normal_consistency",
        "laplacian",
        "vertex_symmetry",
        "image_symmetry",
    ),
    "smoothness": ("vertex_symmetry", "image_symmetry"),
    "vertex_symmetry": ("image_symmetry",),
    "all": (),
}
ABLATION = (PROPORTIONS, *WITHOUT, ASYMMETRIC_ONLY)
BASELINES: Mapping[str, baselines.Step] = {
    "vertices_adam": baselines.adam_step,
    "vertices_large_steps": baselines.large_step,
}
WHITE_BOX = "white_box"
NAMES = (PLAIN, *PRESETS, *ABLATION, *BASELINES, WHITE_BOX)
WITHOUT_CHANCE = frozenset({PROPORTIONS, *BASELINES, WHITE_BOX})  # another seed gives the same
TITLES: Mapping[str, str] = {
    PROPORTIONS: "proportions, no network",
    "silhouette": "silhouette only",
    "smoothness": "+ displacement, normal consistency, Laplacian",
    "vertex_symmetry": "+ vertex symmetry",
    "all": "+ image symmetry (all), lambda_B = 0.0005",
    ASYMMETRIC_ONLY: "all, lambda_B = 1.0",
    "vertices_adam": "vertices, Adam",
    "vertices_large_steps": "vertices, Large Steps",
    WHITE_BOX: "white box: the network's latent code (MeshSDF)",
}


def ablation(config: RefineConfig) -> list[str]:
    """The methods of the ablation table of a preset."""
    return [name for name in ABLATION if name != PROPORTIONS or config.proportions is not None]


def applies(method: str, case: Case) -> bool:
    """Whether a case is among those on which a method is measured."""
    return method != ASYMMETRIC_ONLY or case.asymmetric


def seeds_of(method: str, seeds: Sequence[int]) -> Sequence[int]:
    """The first only, where the others would give the same."""
    return seeds[:1] if method in WITHOUT_CHANCE else seeds


def make_method(name: str, config: RefineConfig) -> Method:
    """One of NAMES, or a plug-in `module:function`; raises SetInvalid for any other name."""
    if name == PLAIN:
        return _engine(config)
    if name in PRESETS:
        return _engine(PRESETS[name]())
    if name in WITHOUT:
        weights = replace(_all_terms(config).weights, **dict.fromkeys(WITHOUT[name], 0.0))
        return _engine(replace(config, weights=weights))
    if name == PROPORTIONS:
        return _proportions(config)
    if name == ASYMMETRIC_ONLY:
        return _engine(replace(_all_terms(config), confidence_cost=1.0))
    if name == WHITE_BOX:
        return white_box
    if name in BASELINES:
        return _baseline(config, BASELINES[name])
    return _plugin(name)


def _all_terms(config: RefineConfig) -> RefineConfig:
    """With image symmetry of the paper's weight where the preset has none."""
    weight = config.weights.image_symmetry or Weights().image_symmetry
    return replace(config, weights=replace(config.weights, image_symmetry=weight))


def told(config: RefineConfig, case: Case) -> RefineConfig:
    """With what a method hears of the case's mirror plane: nothing, or where it is."""
    if case.plane is None or not case.plane_told:
        return config
    return replace(config, symmetry="plane", symmetry_normal=case.plane.normal)


def _engine(config: RefineConfig) -> Method:
    def method(case: Case, scene: Scene, seed: int) -> Outcome:
        result = refine_any_size(scene.coarse, [scene.view], replace(told(config, case), seed=seed))
        curve = result.loss_curve.get("total", ())  # none of a mesh that is returned as it came
        return Outcome(result.mesh, result.seconds, result.confidence, result.plane, tuple(curve))

    return method


def _proportions(config: RefineConfig) -> Method:
    def method(case: Case, scene: Scene, seed: int) -> Outcome:
        started = time.monotonic()
        views, effective = [scene.view], told(config, case)
        iou = mean_silhouette_iou(scene.coarse, views)
        if effective.agreement is not None and iou >= effective.agreement:
            state = keep(scene.coarse, views, effective, iou)
        else:
            state = State.of(fit_whole_mesh(scene.coarse, views, effective), effective)
        return _outcome(state, effective, started)

    return method


def _baseline(config: RefineConfig, step: baselines.Step) -> Method:
    def method(case: Case, scene: Scene, seed: int) -> Outcome:  # nothing in it is random
        started = time.monotonic()
        effective = told(config, case)
        state = baselines.optimise(scene.coarse, [scene.view], effective, step)
        return _outcome(state, effective, started)

    return method


def _outcome(state: State, config: RefineConfig, started: float) -> Outcome:
    """As `refine` hands a state back: without its webs, if the config opens them."""
    faces = state.mesh.faces[state.there] if config.topology != "fixed" else state.mesh.faces
    curve = tuple(state.loss_curve.get("total", ()))
    seconds = time.monotonic() - started
    return Outcome(Mesh(state.mesh.vertices, faces), seconds, state.confidence, state.plane, curve)


def _plugin(name: str) -> Method:
    module, _, attribute = name.partition(":")
    try:
        function: Plugin = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise SetInvalid(
            f"expected a method among {', '.join(NAMES)}, or module:function of a "
            f"plug-in that can be imported, got {name!r} ({error})"
        ) from error

    def method(case: Case, scene: Scene, seed: int) -> Outcome:
        started = time.monotonic()
        mesh = function(scene.coarse, scene.view.silhouette, scene.view.camera)
        return Outcome(mesh, time.monotonic() - started)

    return method
