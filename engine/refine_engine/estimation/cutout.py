"""The object's part of a silhouette as a small square picture, and where it lies in the image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

MARGIN = 1.5  # side of the square over the longest side of the object's box


@dataclass(frozen=True)
class Cutout:
    """N x N pixels around the object; the rest of the image is not looked at."""

    object: Tensor  # (N, N) bool
    known: Tensor  # (N, N) bool: in the image, and not told to be unknown
    left: float  # of the square in the image, pixels
    top: float
    zoom: float  # pixels of the picture per pixel of the image
    size: tuple[int, int]  # height, width of the image

    @staticmethod
    def of(silhouette: Tensor, known: Tensor | None, side: int) -> Cutout:
        """Of an image (H, W) bool with an object; `known` (H, W) bool, None: all of it."""
        rows, columns = silhouette.any(1).nonzero()[:, 0], silhouette.any(0).nonzero()[:, 0]
        top, bottom = int(rows[0]), int(rows[-1]) + 1
        left, right = int(columns[0]), int(columns[-1]) + 1
        square = round(MARGIN * max(bottom - top, right - left, 4))
        left, top = (left + right - square) // 2, (top + bottom - square) // 2
        height, width = silhouette.shape
        pad = (-left, left + square - width, -top, top + square - height)
        everywhere = known if known is not None else silhouette.new_ones(silhouette.shape)
        images = [
            F.interpolate(F.pad(image.float(), pad)[None, None], (side, side), mode="area")[0, 0] > 0.5
            for image in (silhouette, everywhere)
        ]
        return Cutout(images[0], images[1], left, top, side / square, (height, width))

    @property
    def side(self) -> int:
        """N."""
        return len(self.object)

    def lens(self, fov_y_degrees: Tensor) -> Tensor:
        """(B, 3) f, cx, cy in pixels of the picture, of cameras (B,) that look at the image's middle."""
        height, width = self.size
        f = 0.5 * height * self.zoom / (fov_y_degrees.deg2rad() / 2).tan()
        centre = f.new_tensor([(width / 2 - self.left) * self.zoom, (height / 2 - self.top) * self.zoom])
        return torch.cat([f[:, None], centre.expand(len(f), 2)], 1)

    def box(self) -> Tensor:
        """(4,) left, top, right, bottom of the object, pixels of the picture."""
        rows, columns = self.object.any(1).nonzero()[:, 0], self.object.any(0).nonzero()[:, 0]
        return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()
