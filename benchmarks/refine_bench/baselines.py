"""What the network is compared with: the same losses and renders, but the vertices themselves are optimised.

adam_step    plain Adam on the displacements
large_step   Adam on u = (I + lambda L) v with one step size for all, L the uniform Laplacian: Nicolet,
             Jacobson and Jakob, "Large Steps in Inverse Rendering of Geometry", SIGGRAPH Asia 2021

Both start where the network starts, after the fit of the proportions if the config asks for it. The symmetry
confidences are free numbers, one per vertex, instead of the network's second head.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from refine_engine.errors import Diverged
from refine_engine.kernels import image_symmetry, optical_depth, rasterize
from refine_engine.method import losses
from refine_engine.method.config import RefineConfig, Stage
from refine_engine.method.loop import move_as_a_whole
from refine_engine.method.symmetry import mirror_matrix, nearest_mirrored
from refine_engine.method.topology import Topology, neighbour_mean
from refine_engine.method.views import Frame, SymmetryViews, Target
from refine_engine.values import Mesh, View

ADAM_LEARNING_RATE = 1e-3  # normalised lengths per step
LARGE_STEPS_LEARNING_RATE = 3e-3
LARGE_STEPS_LAMBDA = 19.0  # the authors' default
CONFIDENCE_LEARNING_RATE = 3e-2  # per step of the logit
CONFIDENCE_START = 3.0  # logit: 0.95, near full confidence as the network starts
BETAS = (0.9, 0.999)

Step = Callable[[Topology, Tensor], "tuple[Callable[[], Tensor], Callable[[int], None]]"]
"""(topology, start (V, 3)) -> (the current vertices, differentiable; the update of a 1-based iteration)"""


def optimise(
    mesh: Mesh, view: View, config: RefineConfig, step: Step
) -> tuple[Mesh, Tensor, tuple[float, ...]]:
    """Refined mesh, confidence (V,) and total loss per iteration, over the stages of `config`.

    As in the engine, the result is the iterate of the lowest total loss of the last stage.
    """
    objective = _Objective(move_as_a_whole(mesh, [view], config), view, config)
    positions, update = step(objective.topology, objective.coarse)
    logit = torch.full((len(mesh.vertices),), CONFIDENCE_START, requires_grad=True)
    confidences = torch.optim.Adam([logit], CONFIDENCE_LEARNING_RATE)
    curve: list[float] = []
    for stage in config.stages:
        best_total, best = float("inf"), (objective.coarse, logit.detach())
        terms = objective.at(stage)
        for _ in range(stage.iterations):
            vertices, sigma = positions(), torch.sigmoid(logit)
            total = terms(vertices, sigma)
            confidences.zero_grad()
            total.backward()
            curve.append(float(total.detach()))
            if curve[-1] < best_total:
                best_total, best = curve[-1], (vertices.detach().clone(), sigma.detach().clone())
            update(len(curve))
            confidences.step()
    if not np.isfinite(curve).all():
        raise Diverged("expected finite losses, got NaN or infinity while optimising the vertices")
    frame = objective.frame
    return Mesh(best[0] * frame.scale + frame.centre, mesh.faces), best[1], tuple(curve)


def adam_step(topology: Topology, start: Tensor) -> tuple[Callable[[], Tensor], Callable[[int], None]]:
    vertices = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([vertices], ADAM_LEARNING_RATE, BETAS)

    def update(iteration: int) -> None:
        optimiser.step()
        optimiser.zero_grad()

    return lambda: vertices * 1.0, update


def large_step(topology: Topology, start: Tensor) -> tuple[Callable[[], Tensor], Callable[[int], None]]:
    matrix = _system(topology, len(start))
    factor = splu(matrix.tocsc())
    u = torch.from_numpy(matrix @ start.double().numpy()).float().requires_grad_()
    first, second = torch.zeros_like(u), torch.zeros(())

    def update(iteration: int) -> None:
        """Adam whose second moment is one number, so that the step keeps the smoothness of the gradient."""
        nonlocal first, second
        assert u.grad is not None
        with torch.no_grad():
            first = BETAS[0] * first + (1 - BETAS[0]) * u.grad
            second = BETAS[1] * second + (1 - BETAS[1]) * u.grad.square().max()
            mean, scale = first / (1 - BETAS[0] ** iteration), second / (1 - BETAS[1] ** iteration)
            u.sub_(LARGE_STEPS_LEARNING_RATE * mean / (scale.sqrt() + 1e-12))
        u.grad = None

    def positions() -> Tensor:
        vertices: Tensor = _Solve.apply(u, factor)
        return vertices

    return positions, update


class _Solve(torch.autograd.Function):
    """v = (I + lambda L)^-1 u. The matrix is symmetric, so the gradient is the same solve."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, factor: SuperLU) -> Tensor:
        ctx.factor = factor
        return torch.from_numpy(factor.solve(u.detach().double().numpy())).float()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.factor.solve(grads[0].double().numpy())).float(), None


def _system(topology: Topology, count: int) -> Any:
    """I + lambda L (V, V) sparse, L the combinatorial Laplacian."""
    i, j = topology.edges.numpy().T
    ones = np.ones(len(i))
    adjacency = coo_array((ones, (i, j)), shape=(count, count))
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(1)).ravel()
    return eye_array(count) + LARGE_STEPS_LAMBDA * (_diagonal(degree) - adjacency)


def _diagonal(values: Any) -> Any:
    index = np.arange(len(values))
    return coo_array((values, (index, index)), shape=(len(values), len(values)))


class _Objective:
    """The weighted sum of the six losses, as in the engine's loop, of vertices in the normalised frame."""

    def __init__(self, mesh: Mesh, view: View, config: RefineConfig) -> None:
        self.config, self.view = config, view
        self.frame = Frame.of(mesh, config)
        self.coarse = self.frame.normalise(mesh.vertices)
        self.topology = Topology.of(mesh.faces, len(mesh.vertices))
        self.mirror = mirror_matrix(self.frame.normal)

    def at(self, stage: Stage) -> Callable[[Tensor, Tensor], Tensor]:
        """The total loss (vertices (V, 3), confidence (V,)) -> () at a stage's image size and softness."""
        faces, side, cost = self.topology.faces, stage.render_size, self.config.confidence_cost
        target = Target.of([self.view], self.frame, side)
        pairs = SymmetryViews.of(self.config, side, self.frame.normal)
        count, weights = len(pairs.intrinsics) // 2, self.config.weights

        def total(vertices: Tensor, confidence: Tensor) -> Tensor:
            both = pairs.project(vertices)
            depth = optical_depth(torch.cat([target.project(vertices), both]), faces, side, stage.softness)
            visible = rasterize(both[count:], faces, (side, side))
            seen, mirrored = depth[1 : 1 + count], depth[1 + count :]
            nearest = nearest_mirrored(vertices, self.mirror)
            return (
                weights.silhouette * losses.silhouette(depth[:1], target.silhouette, target.known)
                + weights.image_symmetry * image_symmetry(seen, mirrored, visible, faces, confidence, cost)
                + weights.vertex_symmetry
                * losses.vertex_symmetry(vertices, nearest, self.mirror, confidence, cost)
                + weights.displacement * losses.displacement(vertices - self.coarse)
                + weights.normal_consistency * losses.normal_consistency(vertices, self.topology)
                + weights.laplacian * losses.laplacian(vertices, neighbour_mean(vertices, self.topology))
            )

        return total
