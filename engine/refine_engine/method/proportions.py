"""The proportions of the coarse mesh, fitted to the silhouette before the network starts.

A reconstruction network gets an object's proportions and place wrong more than anything else. A network of
per-vertex displacements repairs that only by overcoming its own regularisers, which resist a large uniform
change as much as a wrong bend. So the first step moves the mesh as a whole, with 9 numbers that keep its
mirror plane a mirror plane: scales along the normal and along two directions in the plane, shear and rotation
in the plane, translation, and thickness, which shifts all vertices along their normals. (Networks extract
their surface below one half of occupancy, so as not to lose thin parts: everything is too fat by one length,
which no scale undoes.) Three more numbers, if the config wants them, turn the camera about the object: given
cameras are often a few degrees off. It costs one render per iteration.

The silhouette is compared at every scale of an image pyramid: a sharp render says where the outline is
without bias, and the coarse levels pull it from far away, where a soft render would have to be blurred and
grow. What one silhouette does not see is held by priors: above all the distance from the camera, and the
offset of the mirror plane as closely as the coarse mesh itself defines it. How much the silhouette counts
against them is not known beforehand: its noise is what no motion explains. With an unknown variance, the
likelihood is a power of the remaining difference and the cost its logarithm: where the 12 numbers explain the
picture they may be large, where they do not the mesh stays. Ablation in docs/benchmarks.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..kernels import optical_depth
from ..values import MirrorPlane
from . import losses
from .config import ProportionFit
from .sparse import SparseMatrix
from .symmetry import rotation_from_z
from .views import Target


@dataclass(frozen=True)
class Basis:
    """Where these numbers act: axes of the mirror plane and its normal, about a centre on the plane."""

    axes: Tensor  # (3, 3) columns: two directions in the plane, the normal
    centre: Tensor  # (3,) in those axes

    @staticmethod
    def of(coarse: Tensor, normal: Tensor) -> Basis:
        axes = rotation_from_z(normal)
        centre = (coarse @ axes).mean(0)
        return Basis(axes, centre * centre.new_tensor([1.0, 1.0, 0.0]))

    def move(self, vertices: Tensor, log_scale: Tensor, shear: Tensor, translation: Tensor) -> Tensor:
        """(V, 3) -> (V, 3); log_scale (3,), shear (2,) in the plane, translation (3,), all in these axes."""
        scale, zero = log_scale.exp(), torch.zeros_like(log_scale[0])
        rows = [scale[0], shear[0], zero, shear[1], scale[1], zero, zero, zero, scale[2]]
        matrix = torch.stack(rows).view(3, 3)
        return ((vertices @ self.axes - self.centre) @ matrix.T + self.centre + translation) @ self.axes.T


@dataclass(frozen=True)
class Fitted:
    """A mesh moved as a whole."""

    vertices: Tensor  # (V, 3) normalised
    turn: Tensor  # (3,) rotation vector of the cameras about the origin, camera axes, radians
    shift: float  # of the mirror plane along its normal, normalised
    prior: float  # what the motion costs


def fit_proportions(
    coarse: Tensor,  # (V, 3) normalised
    faces: Tensor,  # (F, 3)
    target: Target,
    plane: MirrorPlane | None,  # through the origin; without an error it is given, and does not move
    fit: ProportionFit,
    proceed: Callable[[], None] = lambda: None,  # called before every iteration; raises to stop
) -> Fitted:
    """The coarse vertices (V, 3) moved as a whole to agree with the silhouettes."""
    normal = coarse.new_tensor([0.0, 0.0, 1.0]) if plane is None else plane.normal
    basis = Basis.of(coarse, normal)
    outward = vertex_normals(coarse, faces)
    numbers = [
        torch.zeros(n, dtype=coarse.dtype, device=coarse.device, requires_grad=True) for n in (3, 2, 3, 1, 3)
    ]
    log_scale, shear, translation, thickness, turn = numbers
    may_shift = plane is None or plane.error is not None
    may_move = coarse.new_tensor([1.0, 1.0, float(may_shift)])
    if plane is None:
        shift_prior = fit.translation_prior
    else:
        shift_prior = fit.plane_prior / max(plane.error or 0.0, 1e-3) ** 2
    forward = target.world_to_camera[:, 2, :3] @ basis.axes  # (B, 3) viewing directions

    optimiser = torch.optim.Adam(numbers, fit.learning_rate)
    for iteration in range(fit.iterations + 1):
        moved_by = translation * may_move
        vertices = basis.move(coarse + thickness * outward, log_scale, shear, moved_by)
        prior = (
            fit.scale_prior * log_scale.square().sum()
            + fit.shear_prior * shear.square().sum()
            + fit.thickness_prior * thickness.square().sum()
            + fit.translation_prior * moved_by[:2].square().sum()
            + fit.depth_prior * (forward @ moved_by).square().mean()
            + shift_prior * moved_by[2].square()
            + (fit.camera_prior or 0.0) * turn.square().sum()
        )
        if iteration == fit.iterations:
            break
        proceed()
        for group in optimiser.param_groups:
            group["lr"] = fit.learning_rate * (1 - iteration / fit.iterations) ** 0.5
        d = difference(vertices, faces, turn, target, fit)
        cost = fit.evidence * torch.log1p(d / fit.noise) + prior
        optimiser.zero_grad()
        cost.backward()
        optimiser.step()
    return Fitted(vertices.detach(), turn.detach(), float(moved_by[2].detach()), float(prior.detach()))


def difference(vertices: Tensor, faces: Tensor, turn: Tensor, target: Target, fit: ProportionFit) -> Tensor:
    """d: squared difference of the images over their pyramid, relative to the object's area; a scalar."""
    cameras = target.world_to_camera if fit.camera_prior is None else turned(target.world_to_camera, turn)
    depth = optical_depth(target.project(vertices, cameras), faces, target.side, fit.softness)
    return losses.silhouette_pyramid(depth, target.silhouette, target.known)


def turned(world_to_camera: Tensor, turn: Tensor) -> Tensor:
    """Cameras (B, 4, 4) turned about the origin by a rotation vector (3,) in their own axes: the origin stays
    where it is in the picture. Differentiable, also at zero."""
    x, y, z = turn.unbind()
    zero = torch.zeros_like(x)
    generator = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    rotation = torch.linalg.matrix_exp(generator) @ world_to_camera[:, :3, :3]
    upper = torch.cat([rotation, world_to_camera[:, :3, 3:]], 2)
    return torch.cat([upper, world_to_camera[:, 3:]], 1)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (V, 3), weighted by the area of the faces; zero where these cancel."""
    a, b, c = vertices[faces].unbind(1)
    corners, count = faces.T.reshape(-1), len(faces)
    of_faces = torch.arange(count, device=faces.device).repeat(3)
    sums = SparseMatrix.of(corners, of_faces, (len(vertices), count)) @ torch.linalg.cross(b - a, c - a)
    return F.normalize(sums, dim=1)
