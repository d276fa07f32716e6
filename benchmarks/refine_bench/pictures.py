"""One picture per result: input, coarse, refined, ground truth, confidence and error, from two viewpoints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from refine_engine.artifacts.error_map import WORST, Surface, longest_side
from refine_engine.artifacts.pictures import (
    Picture,
    confidence_picture,
    encode,
    hard_render,
    on_paper,
    shade,
    side_camera,
)
from refine_engine.values import Camera, Mesh

from .cases import Scene
from .outcome import Outcome

SIDE = 168  # pixels of a panel
MARGIN = 1.35  # of the window around the silhouette
COLUMNS = ("input", "coarse", "refined", "ground truth", "confidence", "error")
MISSING, SURPLUS, BOTH, MASK = (38, 89, 217), (242, 128, 26), (191, 191, 191), (38, 38, 38)


def draw(scene: Scene, outcome: Outcome) -> bytes:
    """PNG, two rows of six panels. Above: as the input camera sees it. Below: from the side, and under the
    input its silhouette against the refined one (grey both, blue only the input, orange only the refined)."""
    window = Window.around(scene.view.silhouette)
    front = window.camera(scene.view.camera)
    truth = scene.ground_truth if isinstance(scene.ground_truth, Mesh) else None
    side = side_camera(front, truth or scene.coarse, SIDE)
    surface, scale = (Surface(truth), WORST * longest_side(truth)) if truth else (None, 0.0)
    mask = window.crop(scene.view.silhouette)
    refined = (hard_render(outcome.mesh, front).face[0] >= 0).numpy()
    rows = []
    for camera, given in ((front, _mask_picture(mask)), (side, _difference(mask, refined))):
        meshes = (scene.coarse, outcome.mesh, truth)
        panels = [given, *(_shaded(mesh, camera) for mesh in meshes), _confidence(outcome, camera)]
        panels.append(surface.error_picture(outcome.mesh, camera, scale) if surface else _blank())
        rows.append(np.concatenate(panels, 1))
    return encode(np.concatenate(rows, 0))


@dataclass(frozen=True)
class Window:
    """The square of the input image that a panel shows, in its pixels; it may reach beyond the image."""

    left: float
    top: float
    side: float

    @staticmethod
    def around(silhouette: Tensor) -> Window:
        """The object with a margin, because the coarse mesh is in other places."""
        rows, columns = (silhouette > 0.5).nonzero().T
        ends = [float(value) for value in (columns.min(), columns.max() + 1, rows.min(), rows.max() + 1)]
        side = MARGIN * max(ends[1] - ends[0], ends[3] - ends[2])
        return Window((ends[0] + ends[1] - side) / 2, (ends[2] + ends[3] - side) / 2, side)

    def camera(self, camera: Camera) -> Camera:
        """The camera whose image is the window, SIDE pixels wide."""
        scale = SIDE / self.side
        return replace(
            camera,
            fx=camera.fx * scale,
            fy=camera.fy * scale,
            cx=(camera.cx - self.left) * scale,
            cy=(camera.cy - self.top) * scale,
            width=SIDE,
            height=SIDE,
        )

    def crop(self, silhouette: Tensor) -> NDArray[np.bool_]:
        """The object in the window (SIDE, SIDE), nearest pixel; nothing outside the image."""
        steps = (np.arange(SIDE) + 0.5) * self.side / SIDE
        row, column = np.floor(self.top + steps).astype(int), np.floor(self.left + steps).astype(int)
        height, width = silhouette.shape
        inside = ((row >= 0) & (row < height))[:, None] & ((column >= 0) & (column < width))
        image = silhouette.numpy() > 0.5
        return np.asarray(inside & image[row.clip(0, height - 1)][:, column.clip(0, width - 1)])


def _shaded(mesh: Mesh | None, camera: Camera) -> Picture:
    return _blank() if mesh is None else shade(mesh, camera, hard_render(mesh, camera))


def _confidence(outcome: Outcome, camera: Camera) -> Picture:
    if outcome.confidence is None:
        return _blank()
    return on_paper(confidence_picture(hard_render(outcome.mesh, camera), outcome.mesh, outcome.confidence))


def _mask_picture(mask: NDArray[np.bool_]) -> Picture:
    picture = _blank()
    picture[mask] = MASK
    return picture


def _difference(mask: NDArray[np.bool_], refined: NDArray[np.bool_]) -> Picture:
    picture = _blank()
    for where, colour in ((mask & refined, BOTH), (mask & ~refined, MISSING), (~mask & refined, SURPLUS)):
        picture[where] = colour
    return picture


def _blank() -> Picture:
    return np.full((SIDE, SIDE, 3), 255, np.uint8)
