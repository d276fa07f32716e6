"""The proportions of the coarse mesh, fitted to the silhouette before the network starts.

A reconstruction network gets an object's proportions and place wrong more than anything else. A network of
per-vertex displacements repairs that only by overcoming its own regularisers, which resist a large uniform
change as much as a wrong bend. So the first step moves the mesh as a whole, with 9 numbers that keep its
mirror plane a mirror plane: scales along the normal and along two directions in the plane, shear and rotation
in the plane, translation, and thickness, which shifts all vertices along their normals. (Networks extract
their surface below one half of occupancy, so as not to lose thin parts: everything is too fat by one length,
which no scale undoes.) It costs one render per iteration.

The silhouette is compared at every scale of an image pyramid: a sharp render says where the outline is
without bias, and the coarse levels pull it from far away, where a soft render would have to be blurred and
grow. What one silhouette does not see is held by a prior: above all the distance from the camera, and the
offset of the mirror plane as closely as the coarse mesh itself defines it. Ablation in docs/benchmarks.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from . import losses, symmetry
from .config import ProportionFit
from .sparse import SparseMatrix
from .views import Target


@dataclass(frozen=True)
class Basis:
    """Where these numbers act: axes of the mirror plane and its normal, about a centre on the plane."""

    axes: Tensor  # (3, 3) columns: two directions in the plane, the normal
    centre: Tensor  # (3,) in those axes

    @staticmethod
    def of(coarse: Tensor, normal: Tensor) -> Basis:
        axes = symmetry.rotation_from_z(normal)
        centre = (coarse @ axes).mean(0)
        return Basis(axes, centre * centre.new_tensor([1.0, 1.0, 0.0]))

    def move(self, vertices: Tensor, log_scale: Tensor, shear: Tensor, translation: Tensor) -> Tensor:
        """(V, 3) -> (V, 3); log_scale (3,), shear (2,) in the plane, translation (3,), all in these axes."""
        off_diagonal = torch.zeros(3, 3, dtype=shear.dtype, device=shear.device)
        off_diagonal = off_diagonal.index_put((_ROW.to(shear.device), _COLUMN.to(shear.device)), shear)
        matrix = torch.diag(log_scale.exp()) + off_diagonal
        return ((vertices @ self.axes - self.centre) @ matrix.T + self.centre + translation) @ self.axes.T


_ROW, _COLUMN = torch.tensor([0, 1]), torch.tensor([1, 0])


def fit_proportions(
    coarse: Tensor,  # (V, 3) normalised
    faces: Tensor,  # (F, 3)
    target: Target,
    normal: Tensor,  # (3,) of the mirror plane through the origin
    mirror_error: float | None,
    fit: ProportionFit,
) -> Tensor:
    """The coarse vertices (V, 3) moved as a whole to agree with the silhouettes.

    `mirror_error` is the mean distance between the coarse surface and its mirror image: how well the mesh
    defines its plane. None: the plane is given and does not move.
    """
    basis = Basis.of(coarse, normal)
    outward = vertex_normals(coarse, faces)
    log_scale, shear, translation, thickness = (
        torch.zeros(n, dtype=coarse.dtype, device=coarse.device, requires_grad=True) for n in (3, 2, 3, 1)
    )
    may_move = coarse.new_tensor([1.0, 1.0, 0.0 if mirror_error is None else 1.0])
    plane_prior = 0.0 if mirror_error is None else fit.plane_prior / max(mirror_error, 1e-3) ** 2
    forward = target.world_to_camera[:, 2, :3] @ basis.axes  # (B, 3) viewing directions
    optimiser = torch.optim.Adam([log_scale, shear, translation, thickness], fit.learning_rate)
    for iteration in range(fit.iterations):
        for group in optimiser.param_groups:
            group["lr"] = fit.learning_rate * (1 - iteration / fit.iterations) ** 0.5
        moved_by = translation * may_move
        vertices = basis.move(coarse + thickness * outward, log_scale, shear, moved_by)
        depth = target.optical_depth(vertices, faces, fit.softness)
        loss = (
            losses.silhouette_pyramid(depth, target.silhouette, target.known)
            + fit.shape_prior * (log_scale.square().sum() + shear.square().sum())
            + fit.thickness_prior * thickness.square().sum()
            + fit.translation_prior * moved_by[:2].square().sum()
            + fit.depth_prior * (forward @ moved_by).square().mean()
            + plane_prior * moved_by[2].square()
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return basis.move(coarse + thickness * outward, log_scale, shear, translation * may_move).detach()


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (V, 3), weighted by the area of the faces; zero where these cancel."""
    a, b, c = vertices[faces].unbind(1)
    corners, count = faces.T.reshape(-1), len(faces)
    of_faces = torch.arange(count, device=faces.device).repeat(3)
    sums = SparseMatrix.of(corners, of_faces, (len(vertices), count)) @ torch.linalg.cross(b - a, c - a)
    return F.normalize(sums, dim=1)
