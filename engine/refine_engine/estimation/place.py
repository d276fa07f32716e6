"""Where an object of known orientation is, so that its picture has a given place and size, in closed form.

Then the search for a camera has the direction and the field of view left to try.
"""

from __future__ import annotations

import torch
from torch import Tensor

STEPS = 8  # of the fixed point; a weak perspective is there after two
NEAREST = 0.2  # between the camera and the object, in its longest side
EXTREMES = 400  # directions in which the farthest vertices are kept


def extreme_points(vertices: Tensor) -> Tensor:
    """Those of the vertices (V, 3) that are farthest in some direction: a bounding box needs no other."""
    return vertices[(vertices @ sphere(EXTREMES).to(vertices).T).argmax(0).unique()]


def sphere(count: int) -> Tensor:
    """Unit vectors (count, 3) spread evenly (Fibonacci's lattice), y from 1 to -1."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    y, angle = 1 - 2 * k / count, torch.pi * (1 + 5**0.5) * k
    radius = (1 - y * y).sqrt()
    return torch.stack([radius * angle.sin(), y, radius * angle.cos()], 1).float()


def place(
    points: Tensor,  # (P, 3) unit frame, see `extreme_points`
    rotation: Tensor,  # (B, 3, 3) world to camera
    lens: Tensor,  # (B, 3) f, cx, cy in pixels
    box: Tensor,  # (4,) left, top, right, bottom of the silhouette, pixels
) -> Tensor:
    """Translations (B, 3) with which the picture's bounding box has the centre and the size of `box`.

    The size is the geometric mean of width and height: wrong proportions count on both sides.
    """
    turned = points @ rotation.transpose(1, 2)  # (B, P, 3)
    f, centre = lens[:, :1], lens[:, 1:]
    wanted_size = ((box[2:] - box[:2]) / f).clamp_min(1e-6)  # (B, 2) at depth 1
    wanted_centre = ((box[2:] + box[:2]) / 2 - centre) / f
    least = NEAREST - turned[..., 2].amin(1, keepdim=True)  # (B, 1)
    spread = (turned[..., :2].amax(1) - turned[..., :2].amin(1)).clamp_min(1e-6)
    depth = torch.maximum((spread / wanted_size).prod(1, keepdim=True).sqrt(), least)
    shift = wanted_centre * depth
    for _ in range(STEPS):
        seen = (turned[..., :2] + shift[:, None]) / (turned[..., 2:] + depth[:, None])
        low, high = seen.amin(1), seen.amax(1)
        ratio = ((high - low).clamp_min(1e-6) / wanted_size).prod(1, keepdim=True).sqrt()
        moved = torch.maximum(depth * ratio, least)
        shift = (shift + (wanted_centre - (low + high) / 2) * depth) * moved / depth
        depth = moved
    return torch.cat([shift, depth], 1)
