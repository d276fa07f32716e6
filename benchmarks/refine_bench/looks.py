"""Colour images of a mesh for networks to look at: one light, one colour, Blinn-Phong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray

from refine_engine.artifacts.pictures import hard_render
from refine_engine.values import Camera, Mesh


@dataclass(frozen=True)
class Look:
    """What differs from image to image besides the viewpoint."""

    light: NDArray[np.float64]  # (3,) unit vector towards the light, camera axes
    ambient: float
    shininess: float
    highlight: float
    colour: NDArray[np.float64]  # (3,) of the surface

    @staticmethod
    def random(rng: Generator) -> Look:
        """Any light from the camera's side, any surface."""
        light = rng.normal(size=3) * [1.0, 1.0, 0.6] - [0.0, 0.8, 0.9]
        return Look(
            light / np.linalg.norm(light),
            ambient=rng.uniform(0.1, 0.45),
            shininess=rng.uniform(4.0, 40.0),
            highlight=rng.uniform(0.0, 0.6),
            colour=rng.uniform(0.25, 0.9, 3),
        )

    @staticmethod
    def studio(rng: Generator) -> Look:
        """The light above left of the camera, matt grey to light surfaces: what a network was trained on."""
        light = np.array([-0.45, -0.65, -0.6]) + 0.08 * rng.normal(size=3)
        colour = rng.uniform(0.5, 0.8) + rng.uniform(-0.08, 0.08, 3)
        return Look(light / np.linalg.norm(light), ambient=0.3, shininess=12.0, highlight=0.15, colour=colour)

    @staticmethod
    def elsewhere(rng: Generator) -> Look:
        """Other light and other surfaces than in the studio, but no extremes."""
        light = rng.normal(size=3) * [1.0, 1.0, 0.6] - [0.0, 0.8, 0.9]
        return Look(
            light / np.linalg.norm(light),
            ambient=rng.uniform(0.2, 0.4),
            shininess=rng.uniform(8.0, 30.0),
            highlight=rng.uniform(0.0, 0.35),
            colour=rng.uniform(0.4, 0.85) + rng.uniform(-0.12, 0.12, 3),
        )


def draw_look(mesh: Mesh, camera: Camera, look: Look, samples: int = 1) -> NDArray[np.uint8]:
    """RGBA (H, W, 4) of the camera's image, `samples` per pixel and axis; flat, both sides alike."""
    fine = replace(
        camera,
        fx=camera.fx * samples,
        fy=camera.fy * samples,
        cx=camera.cx * samples,
        cy=camera.cy * samples,
        width=camera.width * samples,
        height=camera.height * samples,
    )
    face = hard_render(mesh, fine).face[0].numpy()
    vertices = (mesh.vertices @ camera.world_to_camera[:3, :3].T).double()
    a, b, c = vertices[mesh.faces].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1).numpy()
    normal = np.where(normal[:, 2:] > 0, -normal, normal)  # towards the camera
    half = look.light - [0.0, 0.0, 1.0]
    half /= np.linalg.norm(half)
    diffuse = look.ambient + (1 - look.ambient) * np.clip(normal @ look.light, 0.0, 1.0)
    glossy = look.highlight * np.clip(normal @ half, 0.0, 1.0) ** look.shininess
    shade = np.clip(diffuse[:, None] * look.colour + glossy[:, None], 0.0, 1.0)
    covered = (face >= 0)[..., None]
    picture = np.concatenate([shade[face.clip(0)] * covered, covered], -1)
    blocks = picture.reshape(camera.height, samples, camera.width, samples, 4).mean((1, 3))
    blocks[..., :3] /= np.maximum(blocks[..., 3:], 1e-9)
    return np.asarray(blocks.clip(0, 1) * 255 + 0.5, dtype=np.uint8)
