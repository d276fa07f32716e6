"""One picture per result: input, coarse, refined, ground truth and confidence, from two viewpoints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refine_engine.preview import confidence_picture, encode, hard_render, shade, side_camera
from refine_engine.scene import Camera, Mesh

from .cases import Scene
from .methods import Outcome

SIDE = 168  # pixels of a panel
COLUMNS = ("input", "coarse", "refined", "ground truth", "confidence")
MISSING, SURPLUS, BOTH = (0.15, 0.35, 0.85), (0.95, 0.5, 0.1), (0.75, 0.75, 0.75)

Picture = NDArray[np.floating[Any]]


def draw(scene: Scene, outcome: Outcome) -> bytes:
    """PNG, two rows of five panels. Above: as the input camera sees it. Below: from the side, and under the
    input its silhouette against the refined one (grey both, blue only the input, orange only the refined)."""
    front = _square(scene.view.camera)
    side = side_camera(front, scene.ground_truth or scene.coarse, SIDE)
    mask = _fit(scene.view.silhouette).numpy() > 0.5
    refined = (hard_render(outcome.mesh, front).face[0] >= 0).numpy()
    rows = []
    for camera, given in ((front, _mask_picture(mask)), (side, _difference(mask, refined))):
        meshes = (scene.coarse, outcome.mesh, scene.ground_truth)
        panels = [given, *(_shaded(mesh, camera) for mesh in meshes), _confidence(outcome, camera)]
        rows.append(np.concatenate(panels, 1))
    return encode(np.concatenate(rows, 0))


def _square(camera: Camera) -> Camera:
    """The camera with its image padded to a square and scaled to a panel."""
    longest = max(camera.width, camera.height)
    scale = SIDE / longest
    left, top = (longest - camera.width) / 2, (longest - camera.height) / 2
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx + left) * scale,
        cy=(camera.cy + top) * scale,
        width=SIDE,
        height=SIDE,
    )


def _fit(silhouette: Tensor) -> Tensor:
    """The silhouette padded and scaled like the camera."""
    height, width = silhouette.shape
    longest = max(height, width)
    left, top = (longest - width) // 2, (longest - height) // 2
    padded = torch.nn.functional.pad(silhouette, (left, longest - width - left, top, longest - height - top))
    return torch.nn.functional.interpolate(padded[None, None], (SIDE, SIDE), mode="area")[0, 0]


def _shaded(mesh: Mesh | None, camera: Camera) -> Picture:
    return _blank() if mesh is None else shade(mesh, camera, hard_render(mesh, camera))


def _confidence(outcome: Outcome, camera: Camera) -> Picture:
    if outcome.confidence is None:
        return _blank()
    picture = confidence_picture(hard_render(outcome.mesh, camera), outcome.mesh, outcome.confidence)
    alpha = picture[..., 3:]
    return np.asarray(picture[..., :3] * alpha + 1 - alpha)


def _mask_picture(mask: NDArray[np.bool_]) -> Picture:
    return np.where(mask[..., None], 0.15, np.ones(3))


def _difference(mask: NDArray[np.bool_], refined: NDArray[np.bool_]) -> Picture:
    picture = np.ones((*mask.shape, 3))
    for where, colour in ((mask & refined, BOTH), (mask & ~refined, MISSING), (~mask & refined, SURPLUS)):
        picture[where] = colour
    return picture


def _blank() -> Picture:
    return np.ones((SIDE, SIDE, 3))
