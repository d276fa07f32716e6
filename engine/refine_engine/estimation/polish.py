"""Poses improved by the differentiable renderer: some steps towards the silhouette, many poses at once."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ..kernels import optical_depth
from ..method.losses import silhouette_pyramid
from ..values import Mesh
from .cutout import Cutout
from .poses import Poses, rotations

STEPS = 40
LEARNING_RATE = 0.02  # radians, lengths of the object, logarithms
SOFTNESS = 1e-5  # squared device units: a soft outline is biased outwards, and the image pyramid reaches far
LENS_PRIOR = 0.02  # on the squared logarithm of the focal length's change, of which a silhouette says little


def polish(poses: Poses, mesh: Mesh, cutout: Cutout, roll_degrees: float, lens_known: bool) -> Poses:
    """The poses, moved so that their pictures differ less from the cut-out; one that would differ more stays.

    Direction, place, distance and, unless the lens is known, the field of view move.
    """
    start = poses.directions()
    axes = _tangents(start)  # (B, 2, 3)
    ray = poses.translation / poses.translation[:, 2:]
    numbers = torch.zeros(len(poses), 6, requires_grad=True)

    def moved() -> Poses:
        turn, shift, distance, focal = numbers.split([2, 2, 1, 1], 1)
        longer = torch.zeros_like(focal) if lens_known else focal  # logarithm
        direction = F.normalize(start + (turn[..., None] * axes).sum(1), dim=1)
        half_angle = (poses.fov_y_degrees.deg2rad() / 2).tan() * (-longer[:, 0]).exp()
        # A longer lens is farther away, so that it changes the perspective and not the size.
        depth = poses.translation[:, 2:] * (distance + longer).exp()
        place = torch.cat([(ray[:, :2] + shift / poses.translation[:, 2:]) * depth, depth], 1)
        return Poses(rotations(direction, roll_degrees, ray), place, 2 * half_angle.atan().rad2deg())

    optimiser = torch.optim.Adam([numbers], LEARNING_RATE)
    for step in range(STEPS):
        for group in optimiser.param_groups:
            group["lr"] = LEARNING_RATE * (1 - step / STEPS) ** 0.5
        cost = len(poses) * _mean_difference(moved(), mesh, cutout)  # the sum: no two share a number
        cost = cost + LENS_PRIOR * numbers[:, 5].square().sum()
        optimiser.zero_grad()
        cost.backward()
        optimiser.step()
    with torch.no_grad():
        after = moved()
    better = difference(after, mesh, cutout) < difference(poses, mesh, cutout)
    rows = torch.arange(len(poses))
    return Poses.cat([poses, after])[torch.where(better, rows + len(poses), rows)]


@torch.no_grad()
def difference(poses: Poses, mesh: Mesh, cutout: Cutout) -> Tensor:
    """(B,) squared difference of the pictures over their pyramid, relative to the object's area.

    Thin parts that are slightly off differ little, of which a 2D IoU makes much.
    """
    return torch.stack([_mean_difference(poses[[i]], mesh, cutout) for i in range(len(poses))])


def _mean_difference(poses: Poses, mesh: Mesh, cutout: Cutout) -> Tensor:
    depth = optical_depth(poses.project(mesh.vertices, cutout), mesh.faces, cutout.side, SOFTNESS)
    return silhouette_pyramid(depth, cutout.object.float()[None], cutout.known.float()[None])


def _tangents(direction: Tensor) -> Tensor:
    """Two unit vectors across each of the directions: (B, 3) -> (B, 2, 3)."""
    least = F.one_hot(direction.abs().argmin(1), 3).to(direction)
    first = F.normalize(torch.linalg.cross(direction, least), dim=1)
    return torch.stack([first, torch.linalg.cross(direction, first)], 1)
