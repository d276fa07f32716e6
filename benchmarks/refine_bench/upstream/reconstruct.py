"""From the network's occupancy to the coarse mesh: marching cubes, every piece kept, about 1,500 vertices.

Floaters stay, as in the published outputs of occupancy networks: they are part of what a refinement is given.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from refine_engine.values import Mesh

from ..level_set import PUBLISHED_TRIANGLES, level_set
from .network import GRID, HALF_SIDE, Reconstruction
from .photos import Photo, sight_of

OCCUPANCY_LEVEL = 0.3  # of the surface: below one half, as occupancy networks are tuned, to keep thin parts
LARGEST_SHARE = 0.5  # of the largest occupancy: a network that is sure of nothing still answers
LARGEST_LOGIT = 6.0  # beyond it a network is as sure as it can be, and the surface is not to jump


def reconstruct(network: Reconstruction, photo: Photo) -> Mesh:
    """The coarse mesh of a photo, in the frame of the objects"""
    with torch.no_grad():
        return surface(network(sight_of(photo))[0])


def surface(logits: Tensor, triangles: int | None = PUBLISHED_TRIANGLES) -> Mesh:
    """Closed mesh of the level set of logits (40, 40, 40), outward, decimated to `triangles` if given."""
    bounded = np.clip(logits.numpy().astype(np.float64), -LARGEST_LOGIT, LARGEST_LOGIT)
    field = np.pad(bounded, 1, constant_values=-LARGEST_LOGIT)  # closed where the object leaves the grid
    occupancy = min(OCCUPANCY_LEVEL, LARGEST_SHARE / (1 + np.exp(-field.max())))
    level = float(np.log(occupancy / (1 - occupancy)))
    vertices, faces = level_set(field, level, triangles)
    places = (vertices - 0.5) * (2 * HALF_SIDE / GRID) - HALF_SIDE  # values stand at the middles of cells
    return Mesh(torch.from_numpy(places.astype(np.float32)), torch.from_numpy(faces))
