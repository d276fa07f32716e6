"""What OBJ, PLY, STL and OFF files hold: polygons whose corners share positions and not always the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MeshInvalid
from .colour_scale import linear_light
from .limits import MeshLimits
from .triangulate import triangulate
from .weld import Floats, Ints

Part = dict[str, NDArray[Any]]


@dataclass
class Polygons:
    """S positions, and P polygons of C corners in all.

    `of_corner` are attributes by their glTF names with a row per corner: (values (N, K), which (C,)), -1 for
    none; `of_vertex` those with a row per position (S, K).
    """

    positions: Floats  # (S, 3)
    corners: Ints  # (C,) the position of each corner
    sizes: Ints  # (P,) corners of each polygon
    of_vertex: Part
    of_corner: dict[str, tuple[NDArray[Any], Ints]]
    group: Ints | None = None  # (P,) which part of the document a polygon belongs to; None: all to part 0
    warnings: tuple[str, ...] = ()
    materials: tuple[str, ...] = ()  # by part, names in `libraries`; "" for none
    libraries: tuple[str, ...] = ()  # material files
    texture: str | None = None  # an image for the whole mesh

    def parts(self, limits: MeshLimits) -> dict[int, Part]:
        """One dict of vertex attributes and `faces` (F, 3) per group. Raises MeshInvalid."""
        self._check(limits)
        triangles, owner = triangulate(self.positions[self.corners], self.sizes)
        groups = np.zeros(len(self.sizes), np.int64) if self.group is None else self.group
        return {int(g): self._part(triangles[groups[owner] == g]) for g in np.unique(groups[owner])}

    def _check(self, limits: MeshLimits) -> None:
        count = len(self.positions)
        if not np.maximum(self.sizes - 2, 0).any():
            raise MeshInvalid("expected triangles or polygons in the file, got none")
        limits.check_source(count, int(np.maximum(self.sizes - 2, 0).sum()))
        if self.corners.min() < 0 or self.corners.max() >= count:
            raise MeshInvalid(
                f"expected face indices from 0 to {count - 1}, "
                f"got {self.corners.min()} to {self.corners.max()}"
            )
        good = (np.abs(self.positions) <= np.finfo(np.float32).max).all(1)
        if not good.all():
            raise MeshInvalid(
                f"expected finite vertex positions, got NaN or infinity in {int((~good).sum())} of {count} "
                f"vertices (first: {int(good.argmin())})"
            )

    def _part(self, triangles: Ints) -> Part:
        """A vertex per position if nothing differs between corners, else per distinct set of rows."""
        shared = not self.of_corner and self.group is None
        if shared:
            vertex, faces, rows = np.arange(len(self.positions)), self.corners[triangles], []
        else:
            used, place = np.unique(triangles, return_inverse=True)
            table = np.stack([self.corners[used], *(which[used] for _, which in self.of_corner.values())], 1)
            distinct, number = np.unique(table, axis=0, return_inverse=True)
            faces = number.ravel()[place.reshape(triangles.shape)]
            vertex, rows = distinct[:, 0], list(distinct[:, 1:].T)
        part: Part = {"POSITION": self.positions[vertex].astype("<f4"), "faces": faces}
        part["NORMAL"] = np.zeros(
            (len(vertex), 3), "<f4"
        )  # none given: moving the vertices computes them all
        part |= {name: values[vertex] for name, values in self.of_vertex.items()}
        for (name, (values, _)), which in zip(self.of_corner.items(), rows, strict=False):
            part[name] = np.where(which[:, None] >= 0, values[which], 0).astype(values.dtype)
        return part


def texture_coordinates(uv: Floats) -> NDArray[np.float32]:
    """(N, 2) for glTF, which counts a texture's rows from the top; what is not finite becomes 0."""
    flipped = np.stack([uv[:, 0], 1.0 - uv[:, 1]], 1)
    return np.where(np.abs(flipped) <= 1e30, flipped, 0.0).astype("<f4")


def colours(values: Floats, full: float) -> NDArray[np.uint16]:
    """RGBA (N, 4) for glTF, linear, in 16 bits, from sRGB (N, 3 or 4) of which `full` is the largest value.

    8 bits would not tell the dark colours of sRGB apart any more.
    """
    scaled = np.clip(np.nan_to_num(values / full, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    rgba = np.ones((len(values), 4))
    rgba[:, : values.shape[1]] = scaled
    rgba[:, :3] = linear_light(rgba[:, :3])
    return np.round(rgba * 65535).astype("<u2")
