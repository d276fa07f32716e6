"""CUDA back end: the kernels of cuda.cu as torch functions.

Nothing here but the first look at a mesh waits for the card, and nothing reads a value back or allocates by
what the data turn out to be: an iteration of these functions can be captured in a CUDA graph. The memory is
fixed by the shapes: 8 bytes a pixel for a sum or a z-buffer, 24 bytes a face and view for the gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from . import fused, nvrtc
from .fragments import Fragments
from .nvrtc import BLOCK, FRACTION_BITS, LANES, QUERIES
from .oracle import CUTOFF, LEAST_CONFIDENCE

RUN = 256  # candidates of a thread in nearest_point
INDEX_BITS = 0xFFFFFFFF  # the low half of a packed minimum


def keep_float32() -> None:
    """For the whole process: products on a card keep the 24 bits of float32, as on a CPU.

    torch lets cuDNN round the factors of a convolution to the 11 bits of TF32: the encoder's features would
    differ from a CPU's by 1e-3. As with the number of threads, `main` says it once.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


def per_face(faces: int, views: int) -> tuple[int, int]:
    """Grid with a warp for every face of every view."""
    return math.ceil(faces * LANES / BLOCK), views


def per_item(items: int, views: int) -> tuple[int, int]:
    """Grid with a thread for every pixel or vertex of every view."""
    return math.ceil(items / BLOCK), views


def per_query(count: int) -> tuple[int, int]:
    """Grid with a thread for every QUERIES queries and RUN candidates."""
    return math.ceil(count / (BLOCK * QUERIES)), math.ceil(count / RUN)


@dataclass(frozen=True)
class CornerTable:
    """The faces as the kernels read them, and the corners that meet in each vertex."""

    corners: Tensor  # (F, 3) int32, vertex of each corner
    offsets: Tensor  # (V + 1,) int32: the corners of vertex v are incident[offsets[v] : offsets[v + 1]]
    incident: Tensor  # (3F,) int32, index into the flattened corners, ascending within a vertex

    @staticmethod
    def of(faces: Tensor, vertices: int) -> CornerTable:
        """Of faces (F, 3) int64 among so many vertices."""
        flat = faces.reshape(-1)
        ordered, incident = flat.sort(stable=True)
        offsets = torch.searchsorted(ordered, torch.arange(vertices + 1, device=faces.device))
        return CornerTable(*(t.to(torch.int32).contiguous() for t in (faces, offsets, incident)))


_tables = WeakTensorKeyDictionary()  # faces -> its table: built once for each mesh, dropped with it


def _table(faces: Tensor, vertices: int) -> CornerTable:
    table: CornerTable | None = _tables.get(faces)
    if table is None or len(table.offsets) != vertices + 1:
        table = CornerTable.of(faces, vertices)
        if faces.is_cuda:  # another thread may use it on another stream; this is before any recording
            torch.cuda.current_stream(faces.device).synchronize()
        _tables[faces] = table
    return table


def _packed_minima(shape: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.full(shape, -1, dtype=torch.int64, device=device)  # all ones: above every packed minimum


class _OpticalDepth(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, screen: Tensor, faces: Tensor, side: int, softness: float) -> Tensor:
        points = screen.detach().float().contiguous()
        views, vertices = points.shape[:2]
        table = _table(faces, vertices)
        softness_px = softness * (side / 2) ** 2
        ctx.points, ctx.table = points, table
        ctx.sizes = vertices, len(faces), side, 1 / softness_px, math.sqrt(CUTOFF * softness_px)
        image = torch.zeros((views, side, side), dtype=torch.int64, device=points.device)
        grid = per_face(len(faces), views)
        nvrtc.launch("optical_depth", grid, points, table.corners, *ctx.sizes, image)
        return image.float() * 2.0**-FRACTION_BITS

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        grad, points, table = grads[0].contiguous(), ctx.points, ctx.table
        vertices, faces, views = ctx.sizes[0], ctx.sizes[1], len(points)
        of_corners = torch.empty((views, faces, 3, 2), device=points.device)
        grid = per_face(faces, views)
        nvrtc.launch("optical_depth_backward", grid, points, table.corners, *ctx.sizes, grad, of_corners)
        out = torch.empty_like(points)
        grid = per_item(vertices, views)
        nvrtc.launch("gather_corners", grid, of_corners, table.offsets, table.incident, vertices, faces, out)
        return out, None, None, None


def optical_depth(screen: Tensor, faces: Tensor, side: int, softness: float) -> Tensor:
    """S (B, side, side) by the specification in `oracle`, differentiable; a face adds at most 2^20."""
    depth: Tensor = _OpticalDepth.apply(screen, faces, side, softness)
    return depth


def rasterize(screen: Tensor, faces: Tensor, size: tuple[int, int], orthographic: bool = False) -> Fragments:
    """The visible face at every pixel centre by a z-buffer; the lower of two faces at the same depth."""
    points = screen.detach().float().contiguous()
    views, vertices = points.shape[:2]
    corners = _table(faces, vertices).corners
    nearest = _packed_minima((views, *size), points.device)
    view = int(orthographic), *size
    grid = per_face(len(faces), views)
    nvrtc.launch("rasterize", grid, points, corners, vertices, len(faces), *view, nearest)
    face = torch.empty_like(nearest)
    weight = torch.empty((*nearest.shape, 3), device=points.device)
    grid = per_item(size[0] * size[1], views)
    nvrtc.launch("resolve", grid, points, corners, vertices, *view, nearest, face, weight)
    return Fragments(face, weight)


def _symmetry_pass(
    seen: Tensor, mirrored: Tensor, fragments: Fragments, faces: Tensor, confidence: Tensor, cost: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`fused.OnePass`; the gradients of the confidence are fixed-point sums."""
    seen, mirrored, sigma = (t.contiguous() for t in (seen, mirrored, confidence))
    views, side = seen.shape[:2]
    value, d_seen, d_mirrored = torch.empty_like(seen), torch.empty_like(seen), torch.empty_like(seen)
    d_sigma = torch.zeros(len(sigma), dtype=torch.int64, device=seen.device)
    largest = seen.numel() * (1 + cost / LEAST_CONFIDENCE)  # of the sum at one vertex
    one = 2.0 ** math.floor(62 - math.log2(largest))
    corners = _table(faces, len(sigma)).corners
    seen_by_both = seen, mirrored, fragments.face, fragments.barycentric
    derivatives = d_seen, d_mirrored, d_sigma
    grid = per_item(side * side, views)
    settings = float(cost), one, side
    nvrtc.launch("image_symmetry", grid, *seen_by_both, corners, sigma, *settings, value, *derivatives)
    return value.sum(), d_seen, d_mirrored, d_sigma.float() / one


def image_symmetry(
    seen: Tensor, mirrored: Tensor, fragments: Fragments, faces: Tensor, confidence: Tensor, cost: float
) -> Tensor:
    """`oracle.image_symmetry` in one pass: the same value and gradients."""
    return fused.image_symmetry(_symmetry_pass, seen, mirrored, fragments, faces, confidence, cost)


def nearest_point(points: Tensor, queries: Tensor) -> Tensor:
    """For each of the V queries (V, 3) the index (V,) int64 of the nearest of the V points (V, 3).

    Of two at the same distance the lower. Compares all pairs, V^2 distances. Not differentiable.
    """
    best = _packed_minima((len(points),), points.device)
    grid = per_query(len(points))
    nvrtc.launch("nearest_point", grid, points.contiguous(), queries.contiguous(), len(points), RUN, best)
    return best & INDEX_BITS
