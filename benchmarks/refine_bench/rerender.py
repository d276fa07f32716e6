"""RerenderedShapeNet: ShapeNet models rendered again, with other viewpoints, lights and shading.

A network trained on the 3D-R2N2 renderings sees a domain shift in them, while model and pose stay known. The
output has the layout of the 3D-R2N2 renderings, so `ShapeNet` reads it. Colours are for the networks; the
refinement uses the alpha channel only.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from refine_engine.values import Camera, Mesh

from .cases import existing_folder, read_mesh_file, subfolders
from .looks import Look, draw_look
from .sets.shapenet import FOV_DEGREES, METADATA, SYNSETS, metadata_line

SIDE = 137  # pixels, as 3D-R2N2
SAMPLES = 3  # per pixel and axis
ELEVATION_DEGREES = (-10.0, 60.0)  # 3D-R2N2: 25 to 30
DISTANCE = (1.1, 1.75)  # model lengths; 3D-R2N2: 1.14 to 1.75


def rerender_model(mesh: Mesh, folder: Path, views: int, seed: int) -> None:
    """Write `views` images and their metadata into `folder`; the seed names viewpoints and looks."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    lines, names = [], []
    for number in range(views):
        azimuth, elevation = rng.uniform(0.0, 360.0), rng.uniform(*ELEVATION_DEGREES)
        distance = rng.uniform(*DISTANCE)
        camera = Camera.look_at(azimuth, elevation, distance, FOV_DEGREES, SIDE, SIDE)
        names.append(f"{number:02}.png")
        lines.append(metadata_line(azimuth, elevation, distance))
        Image.fromarray(draw_look(mesh, camera, Look.random(rng), SAMPLES)).save(folder / names[-1])
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
