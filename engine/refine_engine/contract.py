"""A run in the words of the contract: its options before it, its judgement after it."""

from __future__ import annotations

from typing import cast

from refine_proto.models import (
    CameraCorrection,
    Judgement,
    MirrorPlane,
    Outcome,
    RefinementOptions,
    SilhouetteIou,
)

from .method.config import RefineConfig, Symmetry, Topology
from .method.presets import make_config
from .values import Result


def config_of(options: RefinementOptions) -> RefineConfig:
    """The engine's configuration for the options of a request; OptionsInvalid."""
    return make_config(
        options.preset,
        options.iterations,
        options.seed,
        cast(Symmetry | None, options.symmetry),  # the same words
        options.symmetry_normal,
        options.symmetry_offset,
        cast(Topology | None, options.topology),
        options.correct_camera,
    )


def judgement_of(result: Result) -> Judgement:
    """What the contract tells of a result."""
    plane, turn = result.plane, result.camera_turn_degrees
    return Judgement(
        silhouette_iou=SilhouetteIou(before=result.silhouette_iou_before, after=result.silhouette_iou_after),
        outcome=Outcome(result.outcome),
        warnings=list(result.warnings),
        mirror_plane=plane
        and MirrorPlane(normal=plane.normal.tolist(), offset=plane.offset, error=plane.error),
        camera_correction=None if turn is None else CameraCorrection(turn_degrees=turn),
    )
