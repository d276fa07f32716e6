"""The step before the network: the object's mirror plane, its proportions, which faces are there, the camera.

The silhouette may be explained by motion or by faces that are not there. Motion is tried first. Where it
leaves much unexplained, a web over a hole has probably dragged the mesh along, and the fit starts again
without the faces that lie outside the silhouette in the coarse mesh's own place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..values import Mesh, MirrorPlane, View
from .config import RefineConfig
from .opening import find_outside
from .planes import mirror_plane
from .proportions import Fitted, difference, fit_proportions, turned
from .views import Frame, Region, Target


@dataclass(frozen=True)
class WholeMesh:
    """What the network starts from, world frame."""

    mesh: Mesh  # moved as a whole, with all faces
    there: Tensor  # (F,) bool: faces that are not webs
    views: tuple[View, ...]  # with their cameras as they are taken to be
    plane: MirrorPlane | None
    camera_turn_degrees: float | None  # None: the cameras are taken to be exact


def fit_whole_mesh(
    mesh: Mesh, views: Sequence[View], config: RefineConfig, proceed: Callable[[], None] = lambda: None
) -> WholeMesh:
    """The coarse mesh with its proportions and place fitted to the silhouettes, as the config asks for it.

    `proceed` is called before every iteration, and may raise to stop.
    """
    plane = mirror_plane(mesh, config)
    everything = torch.ones_like(mesh.faces[:, 0], dtype=torch.bool)
    proportions = config.proportions
    if proportions is None:
        return WholeMesh(mesh, everything, tuple(views), plane, None)
    frame = Frame.of(mesh, plane)
    regions = [Region.around(view, mesh) for view in views]
    target = Target.of(views, regions, frame, proportions.render_size)
    fine = Target.of(views, regions, frame, config.stages[-1].render_size)
    coarse = frame.normalise(mesh.vertices)

    def fit(there: Tensor) -> Fitted:
        return fit_proportions(coarse, mesh.faces[there], target, plane, proportions, proceed)

    fitted = fit(everything)
    left = difference(fitted.vertices, mesh.faces, fitted.turn, target, proportions)
    outside = find_outside(coarse, mesh.faces, fine, config.opening)
    if float(left) > config.opening.explained and outside.any():
        fitted = fit(~outside)
    moved = replace(fine, world_to_camera=turned(fine.world_to_camera, fitted.turn))
    outside = find_outside(fitted.vertices, mesh.faces, moved, config.opening)
    return WholeMesh(
        mesh=Mesh(frame.world(fitted.vertices), mesh.faces),
        there=~outside,
        views=tuple(_turn(view, fitted.turn, frame) for view in views),
        plane=plane and plane.moved_to(plane.offset + fitted.shift * frame.scale),
        camera_turn_degrees=None if proportions.camera_prior is None else float(fitted.turn.norm().rad2deg()),
    )


def _turn(view: View, turn: Tensor, frame: Frame) -> View:
    """The view with its camera turned about the centre of the frame."""
    camera = view.camera
    unit = turned(frame.camera(camera.world_to_camera)[None], turn)[0].to(camera.world_to_camera)
    centre = frame.centre.to(unit)
    world = unit.clone()
    world[:3, 3] = unit[:3, 3] * frame.scale - unit[:3, :3] @ centre
    return replace(view, camera=replace(camera, world_to_camera=world))
