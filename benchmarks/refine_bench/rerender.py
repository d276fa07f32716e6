"""RerenderedShapeNet: ShapeNet models rendered again, with other viewpoints, lights and shading.

A network trained on the 3D-R2N2 renderings sees a domain shift in them, while model and pose stay known. The
output has the layout of the 3D-R2N2 renderings, so `ShapeNet` reads it. Colours are for the networks; the
refinement uses the alpha channel only.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image

from refine_engine.artifacts.pictures import hard_render
from refine_engine.values import Camera, Mesh

from .cases import existing_folder, read_mesh_file, subfolders
from .sets.shapenet import FOV_DEGREES, METADATA, SYNSETS, metadata_line

SIDE = 137  # pixels, as 3D-R2N2
SAMPLES = 3  # per pixel and axis
ELEVATION_DEGREES = (-10.0, 60.0)  # 3D-R2N2: 25 to 30
DISTANCE = (1.1, 1.75)  # model lengths; 3D-R2N2: 1.14 to 1.75
Picture = NDArray[np.float64]


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
        light = rng.normal(size=3) * [1.0, 1.0, 0.6] - [0.0, 0.8, 0.9]
        return Look(
            light / np.linalg.norm(light),
            ambient=rng.uniform(0.1, 0.45),
            shininess=rng.uniform(4.0, 40.0),
            highlight=rng.uniform(0.0, 0.6),
            colour=rng.uniform(0.25, 0.9, 3),
        )


def rerender_model(mesh: Mesh, folder: Path, views: int, seed: int) -> None:
    """Write `views` images and their metadata into `folder`; the seed names viewpoints and looks."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    lines, names = [], []
    for number in range(views):
        azimuth, elevation = rng.uniform(0.0, 360.0), rng.uniform(*ELEVATION_DEGREES)
        distance = rng.uniform(*DISTANCE)
        camera = Camera.look_at(azimuth, elevation, distance, FOV_DEGREES, SIDE * SAMPLES, SIDE * SAMPLES)
        names.append(f"{number:02}.png")
        lines.append(metadata_line(azimuth, elevation, distance))
        Image.fromarray(_draw(mesh, camera, Look.random(rng))).save(folder / names[-1])
    (folder / "renderings.txt").write_text("\n".join(names) + "\n", encoding="ascii")
    (folder / METADATA).write_text("\n".join(lines) + "\n", encoding="ascii")  # last: says that all is there


def rerender(models: Path, target: Path, views: int, seed: int, limit: int | None = None) -> list[str]:
    """Render every model of ShapeNetCore v1 that `target` lacks; what could not be read, as messages."""
    existing_folder(models, "ShapeNetCore v1")
    pairs = [
        (synset, model.name)
        for synset in SYNSETS
        if (models / synset).is_dir()
        for model in subfolders(models / synset)
    ]
    problems = []
    for synset, model in pairs[:limit]:
        folder = target / synset / model / "rendering"
        if (folder / METADATA).exists():
            continue
        try:
            mesh = read_mesh_file(models / synset / model / "model.obj")
        except Exception as error:  # whatever is wrong with one of 40,000 models, the others are rendered
            problems.append(f"{synset}/{model}: {error}")
            continue
        rerender_model(mesh, folder, views, zlib.crc32(f"{seed}/{synset}/{model}".encode()))
    return problems


def _draw(mesh: Mesh, camera: Camera, look: Look) -> NDArray[np.uint8]:
    """RGBA (SIDE, SIDE, 4), Blinn-Phong with one light, flat triangles, both sides alike."""
    face = hard_render(mesh, camera).face[0].numpy()
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
    blocks = picture.reshape(SIDE, SAMPLES, SIDE, SAMPLES, 4).mean((1, 3))
    blocks[..., :3] /= np.maximum(blocks[..., 3:], 1e-9)
    return np.asarray(blocks.clip(0, 1) * 255 + 0.5, dtype=np.uint8)
