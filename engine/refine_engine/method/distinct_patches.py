"""The encoder, computed once for every distinct patch of the silhouette: the same features for less work.

A silhouette is flat but for its outline: nearly all of its 7 x 7 patches are all 0 or all 1. A convolution
gives equal outputs for equal patches, and so do normalisation, ReLU and pooling: the pixels of a feature map
fall into classes of equal value. The classes depend on the image alone, not on the weights, so they are found
once, and a feature map becomes a matrix with one row per class. At 224 x 224 these are a twentieth of the
pixels after the stem, a third in the first stage and most of them in the second.

Its slow twin is `Refiner.features`; both agree but for rounding (tests/unit/engine/test_distinct_patches.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .network import Encoder, ResidualBlock
from .sparse import SparseMatrix


@dataclass(frozen=True)
class Classes:
    """Which pixels of a feature map are equal."""

    image: Tensor  # (H, W) int64 class of each pixel
    share: Tensor  # (1, U) share of the pixels in each class
    patches: Tensor  # (U, k * k) int64 the classes that a pixel of this class was computed from, -1: padding

    @staticmethod
    def of(before: Tensor, size: int, stride: int, padding: int) -> Classes:
        """Of the outputs of a layer whose pixels look at size x size pixels of an image (H, W) of classes."""
        numbered = before[None, None].to(torch.float64) + 1  # padding is 0
        seen = F.unfold(numbered, size, padding=padding, stride=stride)[0].T.to(torch.int64) - 1
        patches, image, count = seen.unique(dim=0, return_inverse=True, return_counts=True)
        side = (before.shape[0] + 2 * padding - size) // stride + 1
        return Classes(image.view(side, side), (count / count.sum())[None], patches)

    def gather(self, before: int) -> SparseMatrix:
        """Takes a feature map of `before` classes (U', C) to the patches of this one, (U * k * k, C)."""
        flat = self.patches.reshape(-1)
        inside = (flat >= 0).nonzero()[:, 0]
        return SparseMatrix.of(inside, flat[inside], (len(flat), before))

    def __len__(self) -> int:
        return len(self.patches)


class DistinctPatches:
    """What an encoder sees of one silhouette at given places, for any weights.

    silhouette (1, 1, N, N); grid (1, 1, V, 2) as in `Refiner.features`.
    """

    def __init__(self, silhouette: Tensor, grid: Tensor) -> None:
        values, image = silhouette[0, 0].unique(return_inverse=True)
        self.stem = Classes.of(image, 7, 2, 3)
        inside = self.stem.patches >= 0
        self.stem_patches = torch.where(inside, values[self.stem.patches.clamp_min(0)], 0.0)  # (U, 49)
        pooled = Classes.of(self.stem.image, 3, 2, 1)
        self.pool = pooled.gather(len(self.stem))
        self.blocks: list[_Block] = []
        before = pooled
        for stride in (1, 1, 2, 1):
            self.blocks.append(_Block(before, stride))
            before = self.blocks[-1].outer
        self.at_vertices = [bilinear(self.blocks[i].outer, grid[0, 0]) for i in (1, 3)]  # each (V, U)

    @property
    def share(self) -> float:
        """How many of the pixels of a feature map are distinct, mean over the convolutions of the blocks."""
        maps = [classes for block in self.blocks for classes in (block.inner, block.outer)]
        return sum(len(classes) / classes.image.numel() for classes in maps) / len(maps)

    def features(self, encoder: Encoder) -> Tensor:
        """(V, 192), differentiable in the encoder's weights."""
        stem_conv, stem_norm = encoder.stem[0], encoder.stem[1]
        x = normalise(self.stem_patches @ _matrix(stem_conv), self.stem.share, stem_norm)
        x = (self.pool @ F.relu_(x)).view(-1, 9, x.shape[1]).amax(1)  # padding 0 is no maximum after ReLU
        seen: list[Tensor] = []
        for block, layers in zip(self.blocks, (*encoder.stage1, *encoder.stage2), strict=True):
            x = block(x, layers)
            if layers in (encoder.stage1[-1], encoder.stage2[-1]):
                seen.append(self.at_vertices[len(seen)] @ x)
        return torch.cat(seen, 1)


class _Block:
    """A residual block on classes: two convolutions, and the shortcut to what its input was there."""

    def __init__(self, before: Classes, stride: int) -> None:
        self.inner = Classes.of(before.image, 3, stride, 1)
        self.outer = Classes.of(self.inner.image, 3, 1, 1)
        self.to_inner, self.to_outer = self.inner.gather(len(before)), self.outer.gather(len(self.inner))
        centre = self.inner.patches[self.outer.patches[:, 4], 4]  # the middle of the middle patch
        rows = torch.arange(len(centre), device=centre.device)
        self.shortcut = SparseMatrix.of(rows, centre, (len(centre), len(before)))

    def __call__(self, x: Tensor, layers: ResidualBlock) -> Tensor:
        y = (self.to_inner @ x).view(len(self.inner), -1) @ _matrix(layers.conv1)
        y = F.relu_(normalise(y, self.inner.share, layers.norm1))
        y = (self.to_outer @ y).view(len(self.outer), -1) @ _matrix(layers.conv2)
        y = normalise(y, self.outer.share, layers.norm2)
        kept = self.shortcut @ x
        if isinstance(layers.shortcut, nn.Sequential):
            conv, norm = layers.shortcut
            kept = normalise(kept @ _matrix(conv), self.outer.share, norm)
        return F.relu_(y + kept)


def _matrix(conv: nn.Module) -> Tensor:
    """The weights (O, C, k, k) of a convolution as the factor (k * k * C, O) of its patches."""
    weight: Tensor = conv.weight  # type: ignore[assignment]
    return weight.permute(2, 3, 1, 0).reshape(-1, len(weight))


def bilinear(seen: Classes, grid: Tensor) -> SparseMatrix:
    """`grid_sample` with padding_mode="border" of a map of classes at grid (V, 2): a matrix (V, U)."""
    side = len(seen.image)
    place = (((grid + 1) * side - 1) / 2).clamp(0, side - 1)
    low = place.floor().to(torch.int64).clamp_max(side - 2)
    (x, y), (u, v) = low.T, (place - low).T
    columns = [seen.image[y + j, x + i] for j in (0, 1) for i in (0, 1)]
    values = [(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]
    rows = torch.arange(len(grid), device=grid.device)
    return SparseMatrix.of(rows.repeat(4), torch.cat(columns), (len(grid), len(seen)), torch.cat(values))


class _Normalise(torch.autograd.Function):
    """Batch normalisation over pixels, of which each row of x stands for its share."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, share: Tensor, gain: Tensor, bias: Tensor, eps: float) -> Tensor:
        centred = x - share @ x
        scale = (share @ centred.square() + eps).rsqrt_()
        standard = centred.mul_(scale)
        ctx.save_for_backward(standard, share, gain * scale)
        return torch.addcmul(bias, standard, gain)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, Tensor, Tensor, None]:
        standard, share, slope = ctx.saved_tensors
        (g,) = grads  # of a class: the sum over its pixels
        d_bias, d_gain = g.sum(0), (g * standard).sum(0)
        through_statistics = torch.addcmul(d_bias, standard, d_gain).mul_(share.T)
        return (g - through_statistics).mul_(slope), None, d_gain, d_bias, None


def normalise(x: Tensor, share: Tensor, norm: nn.Module) -> Tensor:
    """x (U, C) by `norm`, a BatchNorm2d without running statistics; share (1, U): of the pixels, per row."""
    result: Tensor = _Normalise.apply(x, share, norm.weight, norm.bias, norm.eps)
    return result
