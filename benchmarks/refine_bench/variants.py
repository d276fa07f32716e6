"""Cases as people bring them, made of any set's: turned, small in a photo, noisy in camera and mask.

yaw      object and camera turned about Y by 25 to 65 degrees: the mirror plane is not where it is expected
small    the whole image 260 pixels large, somewhere in a photo of 1024 x 768
noisy    the camera off by 3 to 6 degrees of azimuth, 2 to 4 of elevation and 2 to 5 % of distance, and the
         outline off by 1.5 pixels
truth    the true mesh as coarse mesh, with its own silhouette: there is nothing to refine

The name of a case and the variant name its random numbers. Each variant returns new scenes; nothing is
written. What the network saw (`Scene.image`) goes with the scenes whose image and object frame stay.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator
from PIL import Image
from scipy import ndimage
from torch import Tensor

from refine_engine.cameras.seen import hard_silhouette
from refine_engine.scores.scores import SurfacePoints
from refine_engine.values import Camera, Mesh, View

from .cases import Case, CaseSkipped, Plane, Scene

YAW_DEGREES = (25.0, 65.0)
PHOTO_SIZE, OBJECT_SIDE, PHOTO_MARGIN = (1024, 768), 260, 40  # pixels
AZIMUTH_ERROR, ELEVATION_ERROR, DISTANCE_ERROR = (3.0, 6.0), (2.0, 4.0), (0.02, 0.05)  # degrees, share
OUTLINE_ERROR, OUTLINE_SMOOTHNESS = 1.5, 6.0  # pixels: standard deviation, and along the outline


def vary(case: Case, variant: str) -> Case:
    """The case as the variant brings it, under the same name."""
    seed = zlib.crc32(f"{case.name}/{variant}".encode())
    plane = case.plane
    if variant == "yaw" and plane is not None:
        x, y, z = (yaw_rotation(np.random.default_rng(seed)) @ torch.tensor(plane.normal)).tolist()
        plane = Plane((x, y, z), plane.offset)  # turned about the origin, its distance from it stays
    return replace(
        case, load=lambda: VARIANTS[variant](case.load(), np.random.default_rng(seed)), plane=plane
    )


def yaw_rotation(rng: Generator) -> Tensor:
    """(3, 3) about Y; the first numbers that a generator gives."""
    angle = math.radians(float(rng.uniform(*YAW_DEGREES) * rng.choice([-1, 1])))
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _yaw(scene: Scene, rng: Generator) -> Scene:
    turn = yaw_rotation(rng)
    matrix = scene.view.camera.world_to_camera.clone()
    matrix[:3, :3] = matrix[:3, :3] @ turn.T
    view = View(scene.view.silhouette, replace(scene.view.camera, world_to_camera=matrix))
    truth = scene.ground_truth
    if isinstance(truth, Mesh):
        truth = Mesh(truth.vertices @ turn.T, truth.faces)
    elif truth is not None:
        truth = SurfacePoints(truth.points @ turn.T)
    return Scene(Mesh(scene.coarse.vertices @ turn.T, scene.coarse.faces), view, truth)


def _small(scene: Scene, rng: Generator) -> Scene:
    camera, (width, height) = scene.view.camera, PHOTO_SIZE
    scale = OBJECT_SIDE / max(camera.width, camera.height)
    across, down = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    left = int(rng.integers(PHOTO_MARGIN, width - across - PHOTO_MARGIN))
    top = int(rng.integers(PHOTO_MARGIN, height - down - PHOTO_MARGIN))
    given = Image.fromarray((scene.view.silhouette.numpy() > 0.5).astype(np.uint8) * 255)
    photo = Image.new("L", PHOTO_SIZE)
    photo.paste(given.resize((across, down), Image.Resampling.BILINEAR), (left, top))
    fx, fy = camera.fx * across / camera.width, camera.fy * down / camera.height
    cx, cy = camera.cx * across / camera.width + left, camera.cy * down / camera.height + top
    moved = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    silhouette = torch.from_numpy((np.asarray(photo) > 127).astype(np.float32))
    return Scene(scene.coarse, View(silhouette, moved), scene.ground_truth)


def _noisy(scene: Scene, rng: Generator) -> Scene:
    azimuth, elevation = (
        math.radians(float(rng.choice([-1, 1]) * rng.uniform(*error)))
        for error in (AZIMUTH_ERROR, ELEVATION_ERROR)
    )
    farther = 1.0 + float(rng.choice([-1, 1]) * rng.uniform(*DISTANCE_ERROR))
    camera = _orbited(scene.view.camera, scene.coarse, azimuth, elevation, farther)
    inside = scene.view.silhouette.numpy() > 0.5
    outward = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
    noise = ndimage.gaussian_filter(rng.normal(size=inside.shape), OUTLINE_SMOOTHNESS)
    mask = outward + OUTLINE_ERROR * noise / noise.std() > 0
    view = View(torch.from_numpy(mask.astype(np.float32)), camera)
    return Scene(scene.coarse, view, scene.ground_truth, scene.image)


def _orbited(camera: Camera, mesh: Mesh, azimuth: float, elevation: float, farther: float) -> Camera:
    """The camera turned about what it looks at: the point of its axis that is as deep as the object.

    Azimuth about the world's Y, elevation about the camera's X (radians), the distance times `farther`.
    """
    matrix = camera.world_to_camera.double()
    used = mesh.vertices[mesh.faces.unique()].double()
    centre = (used.amin(0) + used.amax(0)) / 2
    depth = float(matrix[2, :3] @ centre + matrix[2, 3])
    pivot = matrix[:3, :3].T @ (torch.tensor([0.0, 0.0, depth], dtype=torch.float64) - matrix[:3, 3])
    c, s = math.cos(azimuth), math.sin(azimuth)
    about_y = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)
    c, s = math.cos(elevation), math.sin(elevation)
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]], dtype=torch.float64)
    rotation = about_x @ matrix[:3, :3] @ about_y.T
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3] = rotation
    moved[:3, 3] = torch.tensor([0.0, 0.0, farther * depth], dtype=torch.float64) - rotation @ pivot
    return replace(camera, world_to_camera=moved.float())


def _truth(scene: Scene, rng: Generator) -> Scene:
    truth, camera = scene.ground_truth, scene.view.camera
    if not isinstance(truth, Mesh):
        raise CaseSkipped("expected a mesh as ground truth to start from, got none or points")
    return Scene(truth, View(hard_silhouette(truth, camera).float(), camera), truth)


VARIANTS: Mapping[str, Callable[[Scene, Generator], Scene]] = {
    "yaw": _yaw,
    "small": _small,
    "noisy": _noisy,
    "truth": _truth,
}
