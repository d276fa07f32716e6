"""What an iteration spends its time on: one numeric specification, several back ends (README.md here).

`oracle` states the specification and computes it in plain torch, on any device; it decides what is right.
`cpu` is the fast path for CPU tensors, `cuda` the one for CUDA tensors. Tests hold them together, values and
gradients. Nothing here knows a mesh, a camera or a weight.
"""

from __future__ import annotations

from torch import Tensor

from . import cpu, cuda, oracle
from .fragments import Fragments, interpolate

__all__ = ["Fragments", "image_symmetry", "interpolate", "nearest_point", "optical_depth", "rasterize"]


def optical_depth(
    screen: Tensor,  # (B, V, 3) x, y in pixels, depth
    faces: Tensor,  # (F, 3) int64
    side: int,  # of the square image, pixels
    softness: float,  # in squared normalised device units (side = 2)
) -> Tensor:
    """S (B, side, side): alpha = 1 - exp(-S). Differentiable with respect to x and y of `screen`."""
    if screen.device.type == "cpu":
        return cpu.optical_depth(screen, faces, side, softness)
    if screen.device.type == "cuda":
        return cuda.optical_depth(screen, faces, side, softness)
    return oracle.optical_depth(screen, faces, side, softness)


def rasterize(
    screen: Tensor,  # (B, V, 3) x, y in pixels, depth
    faces: Tensor,  # (F, 3) int64
    size: tuple[int, int],  # height, width in pixels
    orthographic: bool = False,  # as `screen` was projected
) -> Fragments:
    """The visible face and the weights of its corners at every pixel centre. Not differentiable."""
    if screen.device.type == "cpu":
        return cpu.rasterize(screen, faces, size, orthographic)
    if screen.device.type == "cuda":
        return cuda.rasterize(screen, faces, size, orthographic)
    return oracle.rasterize(screen, faces, size, orthographic)


def image_symmetry(
    seen: Tensor,  # (m, N, N) optical depth at the cameras p
    mirrored: Tensor,  # (m, N, N) optical depth at the reflected cameras T p
    visible: Fragments,  # at T p
    faces: Tensor,  # (F, 3) int64
    confidence: Tensor,  # (V,)
    cost: float,  # lambda_B
) -> Tensor:
    """Equation 9 of the paper with the confidence of the visible faces: a scalar, differentiable.

    Mean over pairs and pixels of sigma (flip(alpha at p) - alpha at T p)^2 + lambda_B ln(1 / sigma), where
    sigma is interpolated on the face that is visible at T p; a pixel without one adds nothing.
    """
    if seen.device.type == "cpu":
        return cpu.image_symmetry(seen, mirrored, visible, faces, confidence, cost)
    if seen.device.type == "cuda":
        return cuda.image_symmetry(seen, mirrored, visible, faces, confidence, cost)
    covered = (visible.face >= 0).to(seen.dtype)
    return oracle.image_symmetry(seen, mirrored, interpolate(visible, faces, confidence), covered, cost)


def nearest_point(points: Tensor, queries: Tensor) -> Tensor:
    """For each of the queries (V, 3) the index (V,) int64 of the nearest of the points (V, 3).

    Exact; of two at the same distance either. Not differentiable.
    """
    points, queries = points.detach(), queries.detach()
    if points.device.type == "cpu":
        return cpu.nearest_point(points, queries)
    if points.device.type == "cuda":
        return cuda.nearest_point(points, queries)
    return oracle.nearest_point(points, queries)
