"""The image symmetry loss as one autograd function around the one pass of a back end.

Because the loss is a scalar, the pass that computes it computes its gradients too, up to the factor that
arrives in `backward`. The plain loss is `oracle.image_symmetry`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .fragments import Fragments

# seen, mirrored, fragments, faces, confidence, cost -> the sum over all pixels, not their mean, and its
# derivatives by seen, mirrored and confidence; shapes as in `kernels.image_symmetry`
OnePass = Callable[[Tensor, Tensor, Fragments, Tensor, Tensor, float], tuple[Tensor, Tensor, Tensor, Tensor]]


class _ImageSymmetry(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        seen: Tensor,
        mirrored: Tensor,
        confidence: Tensor,
        fragments: Fragments,
        faces: Tensor,
        cost: float,
        one_pass: OnePass,
    ) -> Tensor:
        total, *gradients = one_pass(
            seen.detach(), mirrored.detach(), fragments, faces, confidence.detach(), cost
        )
        ctx.gradients, ctx.pixels = gradients, seen.numel()
        return total / seen.numel()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        scale = grads[0] / ctx.pixels
        seen, mirrored, confidence = (g * scale for g in ctx.gradients)
        return seen, mirrored, confidence, None, None, None, None


def image_symmetry(
    one_pass: OnePass,
    seen: Tensor,
    mirrored: Tensor,
    fragments: Fragments,
    faces: Tensor,
    confidence: Tensor,
    cost: float,
) -> Tensor:
    """`kernels.image_symmetry` by the pass of a back end."""
    loss: Tensor = _ImageSymmetry.apply(seen, mirrored, confidence, fragments, faces, cost, one_pass)
    return loss
