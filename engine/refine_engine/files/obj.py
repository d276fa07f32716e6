"""Wavefront OBJ, as its many writers write it: one pass over the lines, in time linear in the bytes."""

from __future__ import annotations

import codecs
from collections import Counter
from typing import Any

import numpy as np

from ..errors import MeshInvalid
from .limits import MeshLimits
from .surface import Polygons, colours, texture_coordinates

_MAX_MATERIALS = 1000  # as parts of the document of their own; beyond it one part holds all
_LEFT_OUT = {
    b"l": "lines",
    b"p": "points",
    b"curv": "free-form curves",
    b"curv2": "free-form curves",
    b"surf": "free-form surfaces",
}


def read_obj(data: bytes, limits: MeshLimits) -> Polygons:
    """Read the polygons. Raises MeshInvalid, or ValueError for words that are no numbers."""
    lines = _lines(data)
    return _Reader(limits).read(lines)


def _lines(data: bytes) -> list[bytes]:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16").encode()
    data = data.removeprefix(codecs.BOM_UTF8)
    return data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()


class _Reader:
    def __init__(self, limits: MeshLimits) -> None:
        self._limits = limits
        self._vertices: list[list[bytes]] = []
        self._uv: list[list[bytes]] = []
        self._normals: list[list[bytes]] = []
        self._corners: tuple[list[int], list[int], list[int]] = ([], [], [])
        self._sizes: list[int] = []
        self._materials: dict[bytes, int] = {b"": 0}
        self._material, self._material_of = 0, list[int]()
        self._libraries: list[str] = []
        self._left_out: Counter[str] = Counter()

    def read(self, lines: list[bytes]) -> Polygons:
        rows = {b"v": self._vertices, b"vt": self._uv, b"vn": self._normals}
        triangles = 0
        for line in lines:
            words = line.partition(b"#")[0].split()
            if not words:
                continue
            if (kind := words[0]) in rows:
                rows[kind].append(words[1:])
            elif kind in (b"f", b"fo"):
                self._face(words[1:])
                triangles += max(len(words) - 3, 0)
                if triangles > self._limits.max_faces:
                    self._limits.check_source(0, triangles)
            elif kind == b"usemtl":
                self._material = self._materials.setdefault(b" ".join(words[1:]), len(self._materials))
            elif kind == b"mtllib":
                self._libraries.append(b" ".join(words[1:]).decode("utf-8", "replace"))
            elif kind in _LEFT_OUT:
                self._left_out[_LEFT_OUT[kind]] += 1
        return self._polygons()

    def _face(self, words: list[bytes]) -> None:
        counts = len(self._vertices), len(self._uv), len(self._normals)
        for word in words:
            parts = word.split(b"/")
            if len(parts) > 3:
                raise MeshInvalid(f"damaged OBJ file: expected a corner like 1/2/3, got {word!r:.40}")
            for slot in range(3):
                text = parts[slot] if slot < len(parts) else b""
                self._corners[slot].append(_index(text, counts[slot]) if text or slot == 0 else -1)
        self._sizes.append(len(words))
        self._material_of.append(self._material)

    def _polygons(self) -> Polygons:
        if not any(size > 2 for size in self._sizes):
            found = f"; it has {', '.join(self._left_out)}" if self._left_out else ""
            points = f" among {len(self._vertices)} points" if self._vertices else ""
            raise MeshInvalid(f"expected triangles or polygons in the OBJ file, got none{points}{found}")
        self._limits.check_source(len(self._vertices), 0)
        warnings = [f"{count} {what} of the OBJ file were left out" for what, count in self._left_out.items()]
        of_vertex, of_corner = {}, {}
        if any(len(row) in (6, 7) for row in self._vertices):
            rgb = [row[3:6] if len(row) in (6, 7) else [b"1"] * 3 for row in self._vertices]
            values = np.array(rgb, np.float64)
            of_vertex["COLOR_0"] = colours(values, 255.0 if np.nanmax(values, initial=0) > 1 else 1.0)
        for slot, (name, kind, rows, width) in enumerate(
            (("TEXCOORD_0", "vt", self._uv, 2), ("NORMAL", "vn", self._normals, 3)), start=1
        ):
            which = np.array(self._corners[slot], np.int64)
            if not (which >= 0).any():
                continue
            if which.max() >= len(rows):
                raise MeshInvalid(
                    f"damaged OBJ file: expected {kind} from 1 to {len(rows)}, got {which.max() + 1}"
                )
            if name == "TEXCOORD_0" and (missing := int((which < 0).sum())):
                warnings.append(f"{missing} of {len(which)} corners have no texture coordinates and got 0 0")
            values = _table(rows, width)
            of_corner[name] = (texture_coordinates(values) if width == 2 else values.astype("<f4"), which)
        corners = np.array(self._corners[0], np.int64)
        if corners.max() >= len(self._vertices):
            raise MeshInvalid(
                f"damaged OBJ file: expected face indices from 1 to {len(self._vertices)}, "
                f"got {corners.max() + 1}"
            )
        polygons = Polygons(
            _table(self._vertices, 3), corners, np.array(self._sizes, np.int64), of_vertex, of_corner
        )
        self._group(polygons, warnings)
        polygons.warnings = tuple(warnings)
        return polygons

    def _group(self, polygons: Polygons, warnings: list[str]) -> None:
        """Make a part of the triangles of each material."""
        group, names = np.array(self._material_of, np.int64), list(self._materials)
        if len(names) > _MAX_MATERIALS:
            warnings.append(f"expected at most {_MAX_MATERIALS} materials, got {len(names)}: left out")
            return
        polygons.libraries = tuple(self._libraries)
        if group.min() != group.max():
            polygons.group, polygons.materials = (
                group,
                tuple(name.decode("utf-8", "replace") for name in names),
            )
        else:
            polygons.materials = (names[group[0]].decode("utf-8", "replace"),)


def _table(rows: list[list[bytes]], width: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    padded = [(row if len(row) >= width else [*row, *[b"0"] * (width - len(row))])[:width] for row in rows]
    if width == 3 and any(len(row) < 3 for row in rows):
        raise MeshInvalid("damaged OBJ file: expected three numbers in a line of v or vn")
    return np.array(padded, np.float64).reshape(-1, width)


def _index(text: bytes, count: int) -> int:
    """From 0, of an index that counts from 1, or back from the last of `count` so far."""
    number = int(text[:20])
    if number == 0:
        raise MeshInvalid("expected face indices from 1, got 0: OBJ counts from 1")
    if number < -count:
        raise MeshInvalid(f"expected face indices from -{count} to -1, got {number}")
    return number - 1 if number > 0 else count + number
