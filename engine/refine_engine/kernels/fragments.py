"""What a hard render sees at each pixel, and attributes carried to it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Fragments:
    """Result of `rasterize`."""

    face: Tensor  # (B, H, W) int64, index of the visible face, -1 = background
    barycentric: Tensor  # (B, H, W, 3) weights of its corners at the point of the face, 0 on background


def interpolate(fragments: Fragments, faces: Tensor, attribute: Tensor) -> Tensor:
    """Barycentric interpolation of a per-vertex attribute (V,) at every pixel, 0 on background: (B, H, W)."""
    corners = faces[fragments.face.clamp_min(0)]  # (B, H, W, 3)
    return (attribute[corners] * fragments.barycentric).sum(-1)
