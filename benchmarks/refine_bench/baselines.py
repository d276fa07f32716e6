"""What the network is compared with: the same losses and renders, but the vertices themselves are optimised.

adam_step    plain Adam on the displacements
large_step   Adam on u = (I + lambda L) v with one step size for all, L the uniform Laplacian: Nicolet,
             Jacobson and Jakob, "Large Steps in Inverse Rendering of Geometry", SIGGRAPH Asia 2021

Both start where the network starts, after the fit of the whole mesh if the config asks for it, and are judged
as it is. Confidences that the network would learn are free numbers here, one per vertex.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from refine_engine.cameras.seen import mean_silhouette_iou
from refine_engine.method.config import RefineConfig
from refine_engine.method.loop import Fit
from refine_engine.method.outcome import State, judge, keep
from refine_engine.method.topology import Topology
from refine_engine.method.whole_mesh import fit_whole_mesh
from refine_engine.values import Mesh, View

ADAM_LEARNING_RATE = 1e-3  # normalised lengths per step
LARGE_STEPS_LEARNING_RATE = 3e-3
LARGE_STEPS_LAMBDA = 19.0  # the authors' default
CONFIDENCE_LEARNING_RATE = 3e-2  # per step of the logit
CONFIDENCE_START = 3.0  # logit: 0.95, near full confidence as the network starts
BETAS = (0.9, 0.999)

Step = Callable[[Topology, Tensor], "tuple[Callable[[], Tensor], Callable[[int], None]]"]
"""(topology, start (V, 3)) -> (the current vertices, differentiable; the update of a 1-based iteration)"""


def optimise(mesh: Mesh, views: Sequence[View], config: RefineConfig, step: Step) -> State:
    """What the engine would hand back, over the stages of `config`; every vertex of `mesh` is used by a face.

    As in the engine, it is the iterate of the lowest total loss of the last stage, unless the coarse mesh
    agrees with its silhouettes already or the result agrees less.
    """
    iou_before = mean_silhouette_iou(mesh, views)
    if config.agreement is not None and iou_before >= config.agreement:
        return keep(mesh, views, config, iou_before)
    whole = fit_whole_mesh(mesh, views, config)
    fit = Fit(whole, config)
    positions, update = step(fit.topology, fit.coarse)
    logit = torch.full_like(fit.coarse[:, 0], CONFIDENCE_START, requires_grad=True)
    confidences = torch.optim.Adam([logit], CONFIDENCE_LEARNING_RATE)
    iteration = 0
    for stage in config.stages:
        fit.enter(stage)
        for _ in range(stage.iterations):
            iteration += 1
            offsets = positions() - fit.coarse
            terms, confidence = fit.terms(offsets, torch.sigmoid(logit))
            confidences.zero_grad()
            terms.sum().backward()
            fit.best.keep(terms.detach(), offsets.detach(), confidence.detach())
            update(iteration)
            confidences.step()
    fit.progress(config.iterations)
    return judge(mesh, whole, fit.state(), config, iou_before)


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
