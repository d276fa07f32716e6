"""Objects and the images of them: what the network is trained on, and three degrees of being away from it.

none      other objects of the categories that it knows, in the same studio
mild      the same categories in other light, from other heights and distances, before a background of clouds
strong    categories that it never saw, in the studio
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image

from refine_engine.values import Camera

from ..cases import mesh_of
from ..looks import Look, draw_look
from ..sets.synthetic import CATEGORIES, FOV_Y_DEGREES, IMAGE_SIDE
from ..shapes import GENERATORS, make_shape, normalised
from .assemblies import assembly
from .network import IMAGE_SIDE as NETWORK_SIDE
from .network import Sight, pose_of

LEVELS = ("none", "mild", "strong")
HELD_OUT = ("bench", "car", "speaker")
ASSEMBLY = "assembly"
KNOWN = tuple(name for name in GENERATORS if name not in HELD_OUT)
CATEGORY = {maker: name for name, makers in CATEGORIES.items() for maker in makers[:2]} | {"mug": "mug"}
STRETCH = (
    0.12  # standard deviation of the logarithm of the scale per axis: classes vary more than their makers
)
STUDIO_ELEVATION, STUDIO_DISTANCE = (20.0, 32.0), (1.5, 1.75)  # degrees; objects' longest side is 1
SHIFTED_ELEVATION, SHIFTED_DISTANCE = (10.0, 45.0), (1.5, 1.9)
STUDIO_GROUND, CLOUDS = (190.0, 243.0), (190, 256)  # colours of the background, 0 to 255
CROP_MARGIN = 1.1
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Photo:
    """An image of 224 x 224 and what is known of it."""

    image: Picture  # (H, W, 3)
    silhouette: NDArray[np.bool_]  # (H, W)
    camera: Camera


def make_object(kind: str, name: str) -> trimesh.Trimesh:
    """The object that a name names, of a category or an ASSEMBLY: stretched, longest side 1, its box centred
    in x and y."""
    seed = zlib.crc32(f"{kind}/{name}".encode())
    of_parts = kind == ASSEMBLY
    shape = normalised(assembly(np.random.default_rng(seed))) if of_parts else make_shape(kind, seed)
    scale = np.exp(np.random.default_rng([seed, 3]).normal(size=3) * STRETCH)
    vertices = shape.vertices * scale
    return trimesh.Trimesh(vertices / np.ptp(vertices, 0).max(), shape.faces, process=False)


def take_photo(shape: trimesh.Trimesh, rng: Generator, shifted: bool) -> Photo:
    """Of an object in the studio, or `shifted`: in other light, from elsewhere, before clouds."""
    elevation = rng.uniform(*(SHIFTED_ELEVATION if shifted else STUDIO_ELEVATION))
    distance = rng.uniform(*(SHIFTED_DISTANCE if shifted else STUDIO_DISTANCE))
    azimuth = rng.uniform(0.0, 360.0)
    mesh = mesh_of(shape)
    camera = Camera.look_at(azimuth, elevation, distance, FOV_Y_DEGREES, IMAGE_SIDE, IMAGE_SIDE)
    drawn = draw_look(mesh, camera, Look.elsewhere(rng) if shifted else Look.studio(rng)).astype(np.float64)
    ground = _clouds(rng) if shifted else rng.uniform(*STUDIO_GROUND) + rng.uniform(-12.0, 12.0, 3)
    alpha = drawn[..., 3:] / 255.0
    image = np.asarray(alpha * drawn[..., :3] + (1.0 - alpha) * ground, np.uint8)
    return Photo(image, drawn[..., 3] > 127, camera)


def sight_of(photo: Photo) -> Sight:
    """One photo as the network is given it: the square around the object, and the camera of that square."""
    across, down, half = _square(photo.silhouette)
    border = int(np.ceil(2 * half))  # the square may reach beyond the image
    wide = Image.fromarray(np.pad(photo.image, ((border, border), (border, border), (0, 0)), mode="edge"))
    left, top = across - half + border, down - half + border
    crop = wide.resize(
        (NETWORK_SIDE, NETWORK_SIDE),
        Image.Resampling.BILINEAR,
        box=(left, top, left + 2 * half, top + 2 * half),
    )
    image = torch.from_numpy(np.array(crop)).permute(2, 0, 1).float() / 255.0
    camera = photo.camera
    to_square = torch.tensor(
        [
            [camera.fx / half, 0.0, (camera.cx - across) / half],
            [0.0, camera.fy / half, (camera.cy - down) / half],
            [0.0, 0.0, 1.0],
        ]
    )
    projection = to_square @ camera.world_to_camera[:3]
    return Sight(image[None], pose_of(camera)[None], projection[None])


def _square(silhouette: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Middle (x, y) and half side, in pixels, of the square around the object."""
    rows, columns = np.nonzero(silhouette)
    ends = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    half = CROP_MARGIN * max(ends[1] - ends[0], ends[3] - ends[2]) / 2
    return float(ends[0] + ends[1]) / 2, float(ends[2] + ends[3]) / 2, float(half)


def _clouds(rng: Generator) -> NDArray[np.float64]:
    """(H, W, 3): soft colours."""
    few = Image.fromarray(rng.integers(*CLOUDS, (5, 5, 3), dtype=np.uint8))
    return np.asarray(few.resize((IMAGE_SIDE, IMAGE_SIDE), Image.Resampling.BICUBIC), np.float64)
