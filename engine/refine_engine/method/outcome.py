"""What a run hands back, judged by what can be known without the truth.

A picture that gets worse is no refinement: then the mesh as it was after the step before is returned, and in
the end the coarse mesh. And a coarse mesh that agrees with its silhouettes already is not touched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ..cameras.seen import mean_silhouette_iou
from ..values import Mesh, MirrorPlane, Outcome, Progress, View
from .config import RefineConfig
from .planes import longest_side, mirror_plane
from .symmetry import surface_confidence
from .whole_mesh import WholeMesh


@dataclass(frozen=True)
class State:
    """A mesh that a run could hand back, world frame, every vertex used by a face."""

    outcome: Outcome
    mesh: Mesh  # with all faces of the coarse mesh
    there: Tensor  # (F,) bool: faces that are not webs
    plane: MirrorPlane | None
    confidence: Tensor  # (V,)
    camera_turn_degrees: float | None = None
    best_iteration: int = 0
    loss_curve: Mapping[str, Sequence[float]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(whole: WholeMesh, config: RefineConfig) -> State:
        """The mesh after it was moved as a whole."""
        confidence = confidence_of(whole.mesh, whole.plane, config)
        turn = whole.camera_turn_degrees
        return State("fitted", whole.mesh, whole.there, whole.plane, confidence, turn)

    def silhouette_iou(self, views: Sequence[View], config: RefineConfig) -> float:
        """2D IoU of what would be handed back."""
        faces = self.mesh.faces[self.there] if config.topology != "fixed" else self.mesh.faces
        return mean_silhouette_iou(Mesh(self.mesh.vertices, faces), views)


def keep(
    mesh: Mesh,
    views: Sequence[View],
    config: RefineConfig,
    silhouette_iou: float,
    report: Callable[[Progress], None] | None = None,
) -> State:
    """The coarse mesh as it came, with its mirror plane and confidences."""
    if report:
        report(Progress(config.iterations, config.iterations, {}, silhouette_iou))
    plane = mirror_plane(mesh, config)
    everything = torch.ones_like(mesh.faces[:, 0], dtype=torch.bool)
    return State("kept", mesh, everything, plane, confidence_of(mesh, plane, config))


def judge(coarse: Mesh, whole: WholeMesh, refined: State, config: RefineConfig, iou_before: float) -> State:
    """The last of coarse, moved as a whole and refined whose 2D IoU is not below that of the coarse mesh.

    The paper hands back what its network made.
    """
    views = whole.views
    if config.proportions is None or refined.silhouette_iou(views, config) >= iou_before:
        return refined
    told = "the network's result agreed less with the silhouette than the coarse mesh did"
    fitted = State.of(whole, config)
    if fitted.silhouette_iou(views, config) >= iou_before:
        state, now = fitted, "the mesh was moved as a whole only"
    else:
        state, now = keep(coarse, views, config, iou_before), "it is returned as it came"
    return replace(state, loss_curve=refined.loss_curve, warnings=(f"{told}: {now}",))


def confidence_of(mesh: Mesh, plane: MirrorPlane | None, config: RefineConfig) -> Tensor:
    """Symmetry confidence (V,), see `symmetry.surface_confidence`; zero for an object without a plane."""
    if plane is None:
        return torch.zeros_like(mesh.vertices[:, 0])
    return surface_confidence(mesh, plane, longest_side(mesh), config.confidence_cost)
