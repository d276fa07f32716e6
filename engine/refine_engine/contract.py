"""A run in the words of the contract: its options before it, its judgement after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from refine_proto.models import (
    CameraAlternative,
    CameraCorrection,
    CameraEstimate,
    Judgement,
    MeshCounts,
    MirrorPlane,
    Outcome,
    RefinementOptions,
    SilhouetteIou,
)

from .cameras.spec import spec_of
from .estimation.estimate import Candidate
from .files.mesh_file import MeshFile
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


def judgement_of(coarse: MeshFile, result: Result, estimate: Sequence[Candidate]) -> Judgement:
    """What the contract tells of the result of refining `coarse`, and of its camera, if it was estimated."""
    plane, turn = result.plane, result.camera_turn_degrees
    return Judgement(
        silhouette_iou=SilhouetteIou(before=result.silhouette_iou_before, after=result.silhouette_iou_after),
        outcome=Outcome(result.outcome),
        warnings=list(result.warnings),
        mirror_plane=plane
        and MirrorPlane(normal=plane.normal.tolist(), offset=plane.offset, error=plane.error),
        camera_correction=None if turn is None else CameraCorrection(turn_degrees=turn),
        camera=estimate_of(estimate) if estimate else None,
        mesh_counts=_mesh_counts(coarse, result),
    )


def _mesh_counts(coarse: MeshFile, result: Result) -> MeshCounts:
    optimised_vertices, optimised_faces = len(coarse.mesh.vertices), len(coarse.mesh.faces)
    if result.proxy is not None:
        optimised_vertices, optimised_faces = result.proxy.vertices, result.proxy.faces
    return MeshCounts(
        vertices=coarse.given_vertices,
        faces=coarse.given_faces,
        source_vertices=len(coarse.vertex_of_source),
        optimised_vertices=optimised_vertices,
        optimised_faces=optimised_faces,
        refined_vertices=len(result.mesh.vertices),
        refined_faces=len(result.mesh.faces),
        removed_faces=int((~result.kept_faces).sum()),
    )


def estimate_of(candidates: Sequence[Candidate]) -> CameraEstimate:
    """What the contract tells of an estimated camera: the first of at least one."""
    best, *others = candidates
    alternatives = [CameraAlternative(**_told(c), mirror_ambiguous=c.mirror_ambiguous) for c in others]
    return CameraEstimate(**_told(best), alternatives=alternatives)


def _told(candidate: Candidate) -> dict[str, Any]:
    return {
        "camera": spec_of(candidate.camera),
        "silhouette_iou": candidate.silhouette_iou,
        "azimuth_degrees": candidate.azimuth_degrees,
        "elevation_degrees": candidate.elevation_degrees,
    }
