"""SyntheticShift: 60 cases made here, so that anyone can check the tables without a download.

Twenty objects, two of each of ten of the paper's categories; in five categories the second one is asymmetric.
Each is seen once and reconstructed badly at three levels of domain shift:

mild          the network knows the class: details are smoothed away
strong        wrong proportions, one side too short, a lost part
out_of_class  the network never saw the class: the mean of three objects of another, in the object's box
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from refine_engine.cameras.seen import hard_silhouette
from refine_engine.values import Camera, Mesh, View

from ..cases import Case, Plane, Scene, mesh_of
from ..coarsen import MILD, STRONG, coarsen, mistake
from ..shapes import ASYMMETRIC, make_shape

LEVELS = ("mild", "strong", "out_of_class")
LOSSY = replace(STRONG, lost_radius=0.14)
IMAGE_SIDE = 224  # pixels
FOV_Y_DEGREES = 60.0

# The paper's category -> what makes its two objects, and the category whose mean is predicted out of class.
CATEGORIES: Mapping[str, tuple[str, str, str]] = {
    "airplane": ("airplane", "airplane", "car"),
    "bench": ("bench", "bench", "sofa"),
    "cabinet": ("cabinet", "open_cabinet", "speaker"),
    "car": ("car", "car", "sofa"),
    "chair": ("chair", "one_armed_chair", "bench"),
    "display": ("display", "display", "lamp"),
    "lamp": ("lamp", "arm_lamp", "display"),
    "sofa": ("sofa", "corner_sofa", "car"),
    "speaker": ("speaker", "speaker", "cabinet"),
    "table": ("table", "desk", "bench"),
}
SMALL_COUNT = 12
MADE_PLANE = Plane((0.0, 0.0, 1.0), 0.0)  # of everything in `shapes`


@dataclass(frozen=True)
class Instance:
    """What makes a case: the same numbers give the same case everywhere."""

    category: str
    generator: str
    number: int  # of the object in its category
    level: str

    @property
    def name(self) -> str:
        return f"{self.generator}_{self.number}_{self.level}"

    @property
    def seed(self) -> int:
        """Of the object and its camera: the same at all levels."""
        return zlib.crc32(f"{self.category}/{self.number}".encode())  # hash() differs from run to run


def objects() -> list[tuple[str, str, int]]:
    """The twenty: category, generator and number in the category; the first ones of all categories first."""
    return [
        (category, makers[number], number)
        for number in (0, 1)
        for category, makers in CATEGORIES.items()
    ]  # fmt: skip


def synthetic_cases(subset: str = "full") -> list[Case]:
    """60 cases, or with the subset "small" 12 of them: every category once, four of each level."""
    entries = objects()
    if subset == "small":
        rest = [entry for entry in entries[len(CATEGORIES) :] if entry[1] in ASYMMETRIC]
        chosen = [*entries[: len(CATEGORIES)], *rest][:SMALL_COUNT]
        instances = [Instance(*entry, LEVELS[k % len(LEVELS)]) for k, entry in enumerate(chosen)]
    else:
        instances = [Instance(*entry, level) for entry in entries for level in LEVELS]
    return [
        Case(
            instance.name,
            instance.category,
            partial(make_scene, instance),
            instance.level,
            instance.generator in ASYMMETRIC,
            MADE_PLANE,
        )
        for instance in instances
    ]


def make_scene(instance: Instance) -> Scene:
    """The object, a view of it, and the reconstruction of its level."""
    shape = make_shape(instance.generator, instance.seed)
    ground_truth = mesh_of(shape)
    error_seed = instance.seed % 2**31 + LEVELS.index(instance.level)
    if instance.level == "out_of_class":
        other = CATEGORIES[instance.category][2]
        known = [make_shape(CATEGORIES[other][0], instance.seed + k) for k in (1, 2, 3)]
        coarse = mistake(shape, known, error_seed, replace(STRONG, shortening=0.0))
    else:
        coarse = coarsen(shape, error_seed, MILD if instance.level == "mild" else LOSSY)
    return Scene(mesh_of(coarse), full_view(ground_truth, instance.seed), ground_truth)


def full_view(truth: Mesh, seed: int) -> View:
    """The silhouette of the whole object by the camera that the seed names."""
    camera = random_camera(seed)
    return View(hard_silhouette(truth, camera).float(), camera)


def random_camera(seed: int) -> Camera:
    """Any azimuth, elevations and object sizes as in the 3D-R2N2 renderings."""
    rng = np.random.default_rng([seed, 2])
    azimuth, elevation = rng.uniform(0.0, 360.0), rng.uniform(20.0, 32.0)
    distance = rng.uniform(1.5, 1.75)
    return Camera.look_at(azimuth, elevation, distance, FOV_Y_DEGREES, IMAGE_SIDE, IMAGE_SIDE)
