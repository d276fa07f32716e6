"""What a network really gets wrong: photos of objects made here, reconstructed by a network of `upstream`.

A seed names a set, so that one can be developed on and another judged by. The levels are those of `photos`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
import trimesh

from refine_engine.values import View

from ..cases import Case, Scene, mesh_of
from ..shapes import ASYMMETRIC
from ..upstream.network import Kind, load_network
from ..upstream.photos import CATEGORY, HELD_OUT, KNOWN, LEVELS, Photo, make_object, take_photo
from ..upstream.reconstruct import reconstruct
from .synthetic import MADE_PLANE

network = cache(load_network)


@dataclass(frozen=True)
class Instance:
    """What makes a case: one object, one photo."""

    generator: str
    number: int
    level: str
    seed: int
    network: Kind = "image"

    @property
    def name(self) -> str:
        return f"{self.generator}_{self.number}_{self.level}"


def upstream_cases(seed: int = 0, count: int = 16, kind: Kind = "image") -> list[Case]:
    """`count` cases of each level, the kinds of objects in turn."""
    instances = [
        Instance(kinds[k % len(kinds)], k // len(kinds), level, seed, kind)
        for level in LEVELS
        for kinds in [HELD_OUT if level == "strong" else KNOWN]
        for k in range(count)
    ]
    return [case_of(instance) for instance in instances]


def case_of(instance: Instance) -> Case:
    return Case(
        instance.name,
        CATEGORY[instance.generator],
        partial(make_scene, instance),
        instance.level,
        instance.generator in ASYMMETRIC,
        MADE_PLANE,
    )


def photograph(instance: Instance) -> tuple[trimesh.Trimesh, Photo]:
    """The object and the photo of it."""
    name = f"test/{instance.seed}/{instance.level}/{instance.number}"
    shape = make_object(instance.generator, name)
    rng = np.random.default_rng(zlib.crc32(f"{instance.generator}/{name}".encode()))
    return shape, take_photo(shape, rng, shifted=instance.level == "mild")


def make_scene(instance: Instance) -> Scene:
    """The object, its photo, and what the network makes of it."""
    shape, photo = photograph(instance)
    view = View(torch.from_numpy(photo.silhouette).float(), photo.camera)
    coarse = reconstruct(network(instance.network), photo)
    return Scene(coarse, view, mesh_of(shape), photo.image, instance.network)
