"""Cameras of which the direction is chosen, and the rest follows from the silhouette."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..cameras.project import project
from ..kernels import rasterize
from ..values import Mesh
from .cutout import Cutout
from .place import extreme_points, place

BATCH = 64  # pictures drawn at a time


@dataclass(frozen=True)
class Poses:
    """B cameras of the unit frame, where the object's box is 1 long and about the origin."""

    rotation: Tensor  # (B, 3, 3) world to camera, OpenCV axes
    translation: Tensor  # (B, 3)
    fov_y_degrees: Tensor  # (B,)

    @staticmethod
    def of(mesh: Mesh, cutout: Cutout, direction: Tensor, fov_y_degrees: float, roll_degrees: float) -> Poses:
        """Cameras that see the mesh from the directions (B, 3), where the cut-out shows it, as large."""
        fov = torch.full((len(direction),), fov_y_degrees)
        lens, box = cutout.lens(fov), cutout.box()
        middle = ((box[:2] + box[2:]) / 2 - lens[:, 1:]) / lens[:, :1]
        rotation = rotations(direction, roll_degrees, F.pad(middle, (0, 1), value=1.0))
        return Poses(rotation, place(extreme_points(mesh.vertices), rotation, lens, box), fov)

    @staticmethod
    def cat(poses: Iterable[Poses]) -> Poses:
        """All of them."""
        parts = [(p.rotation, p.translation, p.fov_y_degrees) for p in poses]
        return Poses(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def __len__(self) -> int:
        return len(self.fov_y_degrees)

    def __getitem__(self, which: Tensor | list[int]) -> Poses:
        return Poses(self.rotation[which], self.translation[which], self.fov_y_degrees[which])

    def directions(self) -> Tensor:
        """(B, 3) unit, from the middle of the object to the camera."""
        return F.normalize(-(self.rotation.transpose(1, 2) @ self.translation[..., None])[..., 0], dim=1)

    def project(self, vertices: Tensor, cutout: Cutout) -> Tensor:
        """Screen coordinates (B, V, 3) in the cut-out of vertices (V, 3)."""
        upper = torch.cat([self.rotation, self.translation[..., None]], 2)
        last = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(len(self), 1, 4)
        lens = cutout.lens(self.fov_y_degrees)
        return project(vertices, torch.cat([upper, last], 1), torch.cat([lens[:, :1], lens], 1))

    def overlap(self, mesh: Mesh, cutout: Cutout) -> Tensor:
        """2D IoU (B,) of the known pixels of the cut-out."""
        size = (cutout.side, cutout.side)
        scores = []
        for part in torch.arange(len(self)).split(BATCH):
            drawn = rasterize(self[part].project(mesh.vertices, cutout), mesh.faces, size).face >= 0
            drawn &= cutout.known
            both, either = drawn & cutout.object, drawn | cutout.object
            scores.append(both.flatten(1).sum(1) / either.flatten(1).sum(1))
        return torch.cat(scores)


def rotations(direction: Tensor, roll_degrees: float, ray: Tensor) -> Tensor:
    """(B, 3, 3) of cameras that see the object from `direction` (B, 3) along `ray` (B, 3) of their own axes.

    The world's +Y is up in the picture, but for the roll (clockwise turn of the camera). From straight above
    -Z is, from straight below +Z: the limit of `Camera.look_at` at azimuth 0. Differentiable elsewhere.
    """
    forward = -direction
    up = torch.tensor([0.0, 1.0, 0.0]).expand_as(forward)
    steep = forward[:, 1:2].detach().abs() > 1 - 1e-6
    up = torch.where(steep, torch.tensor([0.0, 0.0, 1.0]) * forward[:, 1:2].detach().sign(), up)
    right = F.normalize(torch.linalg.cross(forward, up), dim=1)
    looking = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    cos, sin = math.cos(math.radians(roll_degrees)), math.sin(math.radians(roll_degrees))
    roll = torch.tensor([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return _onto(ray) @ roll @ looking


def _onto(ray: Tensor) -> Tensor:
    """The smallest rotations (B, 3, 3) that take +Z to the rays (B, 3), which point forward."""
    x, y, z = F.normalize(ray, dim=1).unbind(1)
    k = 1 / (1 + z)
    rows = [1 - k * x * x, -k * x * y, x, -k * x * y, 1 - k * y * y, y, -x, -y, z]
    return torch.stack(rows, 1).view(-1, 3, 3)
