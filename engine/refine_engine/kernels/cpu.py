"""CPU back end: the kernels, driven over the views by a small thread pool, as an autograd function.

The pool has as many threads as torch uses inside an operator (`torch.set_num_threads`, set once in `main`):
the two never run at the same time, so one number bounds both.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from . import cpu_numba, fused
from .fragments import Fragments
from .oracle import CUTOFF


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="refine-silhouette")


def _each_view(views: int, work: Callable[[int], None]) -> None:
    threads = min(torch.get_num_threads(), views)
    if threads == 1:
        for view in range(views):
            work(view)
    else:
        list(_pool(torch.get_num_threads()).map(work, range(views)))


_scratches = threading.local()


def _scratch(views: int, side: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Memory for `next_nonzero`, this thread's until its next call: fresh pages every iteration cost more."""
    shape = views, side
    if getattr(_scratches, "shape", None) != shape:
        _scratches.shape = shape
        _scratches.padded = np.empty((views, side, side + cpu_numba.LANES), np.float32)
        _scratches.following = np.empty((views, side, side + 1), np.int32)
    return _scratches.padded, _scratches.following


class _OpticalDepth(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, screen: Tensor, faces: Tensor, side: int, softness: float) -> Tensor:
        points = screen.detach().contiguous().numpy()
        corners = faces.to(torch.int32).numpy()
        softness_px = softness * (side / 2) ** 2
        radius = math.sqrt(CUTOFF * softness_px)
        image = np.zeros((len(points), side, side + cpu_numba.LANES), np.float32)
        args = np.float32(softness_px), np.float32(radius)
        _each_view(len(points), lambda i: cpu_numba.optical_depth(points[i], corners, *args, image[i]))
        ctx.points, ctx.corners, ctx.args = points, corners, args
        return torch.from_numpy(image)[:, :, :side]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        grad = grads[0].numpy()
        views, side = grad.shape[0], grad.shape[1]
        padded, following = _scratch(views, side)
        out = np.zeros((views, ctx.points.shape[1], 3), np.float32)

        def one(i: int) -> None:
            cpu_numba.next_nonzero(grad[i], padded[i], following[i])
            cpu_numba.optical_depth_backward(
                ctx.points[i], ctx.corners, *ctx.args, padded[i], following[i], out[i]
            )

        _each_view(views, one)
        return torch.from_numpy(out), None, None, None


def optical_depth(screen: Tensor, faces: Tensor, side: int, softness: float) -> Tensor:
    """S (B, side, side) by the specification in `oracle`, differentiable."""
    result: Tensor = _OpticalDepth.apply(screen, faces, side, softness)
    return result


def rasterize(screen: Tensor, faces: Tensor, size: tuple[int, int], orthographic: bool = False) -> Fragments:
    """The visible face at every pixel centre by a z-buffer."""
    points, corners = screen.detach().contiguous().numpy(), faces.to(torch.int32).numpy()
    views = len(points)
    depth: NDArray[np.float32] = np.empty((views, *size), np.float32)
    face = np.empty((views, *size), np.int64)
    weight = np.empty((views, *size, 3), np.float32)
    _each_view(
        views, lambda i: cpu_numba.rasterize(points[i], corners, orthographic, depth[i], face[i], weight[i])
    )
    return Fragments(torch.from_numpy(face), torch.from_numpy(weight))


def _symmetry_pass(
    seen: Tensor, mirrored: Tensor, fragments: Fragments, faces: Tensor, confidence: Tensor, cost: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`fused.OnePass`, view by view; the views' gradients of the confidence are added in their order."""
    views = len(seen)
    s, m, sigma = seen.numpy(), mirrored.numpy(), confidence.numpy()
    face, weight = fragments.face.numpy(), fragments.barycentric.numpy()
    corners = faces.to(torch.int32).numpy()
    d_seen, d_mirrored = np.empty(s.shape, np.float32), np.empty(s.shape, np.float32)
    d_sigma = np.zeros((views, len(sigma)), np.float32)
    total = np.zeros(views)

    def one(i: int) -> None:
        seen_by_both = s[i], m[i], face[i], weight[i]
        derivatives = d_seen[i], d_mirrored[i], d_sigma[i]
        total[i] = cpu_numba.image_symmetry(*seen_by_both, corners, sigma, np.float32(cost), *derivatives)

    _each_view(views, one)
    by_seen, by_mirrored, by_sigma = (torch.from_numpy(g) for g in (d_seen, d_mirrored, d_sigma.sum(0)))
    return torch.tensor(total.sum(), dtype=torch.float32), by_seen, by_mirrored, by_sigma


def image_symmetry(
    seen: Tensor, mirrored: Tensor, fragments: Fragments, faces: Tensor, confidence: Tensor, cost: float
) -> Tensor:
    """`oracle.image_symmetry` in one pass: the same value and gradients."""
    return fused.image_symmetry(_symmetry_pass, seen, mirrored, fragments, faces, confidence, cost)


def nearest_point(points: Tensor, queries: Tensor) -> Tensor:
    """`oracle.nearest_point` by a k-d tree, which refuses NaN: the loss tells that the run diverged."""
    tree = cKDTree(torch.nan_to_num(points).numpy(), balanced_tree=False)  # quicker to build and as exact
    return torch.from_numpy(tree.query(torch.nan_to_num(queries).numpy())[1])
