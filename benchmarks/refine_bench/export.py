"""Writes the cases of any set as folders, the layout that `refine bench folder` reads."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from refine_engine.values import Camera, Mesh

from .cases import Case

LOOK_AT_TOLERANCE = 1e-4  # of the matrix and, in pixels, of the principal point


def export_case(case: Case, root: Path) -> Path:
    """Write `root`/LEVEL/NAME, or `root`/NAME where the set has no levels; returns the folder.

    coarse.obj, silhouette.png, camera.json and, where there are such, gt.obj or gt.xyz, image.png and
    symmetry.json.
    """
    folder, scene = root / case.level / case.name, case.load()
    folder.mkdir(parents=True, exist_ok=True)
    _write_obj(scene.coarse, folder / "coarse.obj")
    if isinstance(scene.ground_truth, Mesh):
        _write_obj(scene.ground_truth, folder / "gt.obj")
    elif scene.ground_truth is not None:
        np.savetxt(folder / "gt.xyz", scene.ground_truth.points.numpy(), "%.9g")
    coverage = (scene.view.silhouette * 255).round().byte().numpy()
    Image.fromarray(coverage).save(folder / "silhouette.png")
    if scene.image is not None:
        Image.fromarray(scene.image).save(folder / "image.png")
    if case.plane is not None:
        _write_json(asdict(case.plane) | {"asymmetric": case.asymmetric}, folder / "symmetry.json")
    _write_json(camera_spec(scene.view.camera), folder / "camera.json")  # last: says that the case is whole
    return folder


def camera_spec(camera: Camera) -> dict[str, Any]:
    """The camera as docs/conventions.md writes it: `look_at` where it looks at the origin, else `matrix`."""
    matrix = camera.world_to_camera.double()
    place = -matrix[:3, :3].T @ matrix[:3, 3]
    distance = float(place.norm())
    fov = 2 * math.degrees(math.atan(0.5 * camera.height / camera.fy))
    if camera.projection == "perspective" and distance > 0.0:
        azimuth = math.degrees(math.atan2(float(place[0]), float(place[2])))
        elevation = math.degrees(math.asin(float(place[1]) / distance))
        same = Camera.look_at(azimuth, elevation, distance, fov, camera.width, camera.height)
        if _agree(same, camera):
            return {
                "type": "look_at",
                "azimuth_degrees": azimuth,
                "elevation_degrees": elevation,
                "distance": distance,
                "fov_y_degrees": fov,
            }
    names = ("fx", "fy", "cx", "cy", "width", "height")
    return {
        "type": "matrix",
        "convention": "opencv",
        "world_to_camera": matrix.tolist(),
        "intrinsics": {name: getattr(camera, name) for name in names},
    } | ({"projection": camera.projection} if camera.projection != "perspective" else {})


def _agree(first: Camera, second: Camera) -> bool:
    matrices = torch.allclose(first.world_to_camera, second.world_to_camera, atol=LOOK_AT_TOLERANCE)
    one, other = ([camera.fx, camera.fy, camera.cx, camera.cy] for camera in (first, second))
    return matrices and bool(np.allclose(one, other, rtol=0.0, atol=LOOK_AT_TOLERANCE))


def _write_json(value: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def _write_obj(mesh: Mesh, path: Path) -> None:
    """Vertices to nine digits: read again, the float32 positions are the same."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
