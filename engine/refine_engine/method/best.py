"""The best iterate of a run and its loss curve, kept on the device: nothing here waits for it."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Best:
    """The iterate of the lowest total loss since `forget`, and every iteration's losses."""

    def __init__(self, vertices: Tensor, iterations: int, terms: int) -> None:
        self.iteration = vertices.new_zeros(1, dtype=torch.int64)  # done so far
        self.curve = vertices.new_zeros(iterations, terms + 1)  # weighted terms, total
        self.total = vertices.new_full((), math.inf)
        self.offsets = torch.zeros_like(vertices)  # (V, 3)
        self.confidence = torch.ones_like(vertices[:, 0])  # (V,)
        self.at = torch.zeros_like(self.iteration)  # 1-based

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All that is remembered."""
        return self.iteration, self.curve, self.total, self.offsets, self.confidence, self.at

    def forget(self) -> None:
        """Losses from here on do not compare with those before."""
        self.total.fill_(math.inf)

    def keep(self, terms: Tensor, offsets: Tensor, confidence: Tensor) -> None:
        """Write the loss curve, and remember this iterate if it is the best so far."""
        total = terms.sum()
        self.curve.index_copy_(0, self.iteration, torch.cat([terms, total[None]])[None])
        self.iteration += 1
        better = total < self.total
        for best, now in (
            (self.total, total),
            (self.offsets, offsets),
            (self.confidence, confidence),
            (self.at, self.iteration),
        ):
            torch.where(better, now, best, out=best)
