"""Voxel grids as surfaces: .binvox files and NumPy's .npz with one array of three dimensions.

A .binvox file says where its grid lies. An .npz may say so in the same words, by arrays `translate` (3,),
the corner of the grid, and `scale` (), the length of its longest side; else that side is 1 and the grid is
centred on the origin. Axes are x, y, z.
"""

from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import MeshInvalid
from .beside import checked_archive, member_content, member_head
from .isosurface import border_mean, check_cells, isosurface
from .limits import MeshLimits
from .surface import Polygons
from .weld import Floats

_MAX_HEADER = 10_000  # bytes, of either format
_RATIO = 1100  # more than deflate can: an empty grid is all zeros, and its size is checked by its header


def read_binvox(data: bytes, limits: MeshLimits) -> Polygons:
    """Read the occupied cells. Raises MeshInvalid, or ValueError for words that are no numbers."""
    head, mark, runs = data.partition(b"\ndata\n")
    if not mark or len(head) > _MAX_HEADER:
        raise MeshInvalid("truncated or damaged binvox file: expected a header up to a line 'data'")
    words = {line.split()[0]: line.split()[1:] for line in head.splitlines() if line.split()}
    shape = tuple(int(word[:20]) for word in words[b"dim"])
    check_cells(shape)
    pairs = np.frombuffer(runs[: len(runs) // 2 * 2], np.uint8).reshape(-1, 2)
    if (cells := int(pairs[:, 1].sum(dtype=np.int64))) != np.prod(shape):
        raise MeshInvalid(f"truncated or damaged binvox file: expected {shape} cells, got {cells}")
    occupied = np.repeat(pairs[:, 0] > 0, pairs[:, 1]).reshape(shape).transpose(0, 2, 1)  # stored as x, z, y
    corner = np.array(words.get(b"translate", [b"0"] * 3), np.float64)
    scale = float(words.get(b"scale", [b"1"])[0])
    return _placed(occupied, 0.5, 0.0, corner, scale, limits)


def read_npz(data: bytes, limits: MeshLimits) -> Polygons:
    """Read the one array of three dimensions: bool or whole numbers (0 is empty), occupancies from 0 to 1, or
    signed distances, whose sign on the border of the grid is outside. Raises MeshInvalid."""
    archive = checked_archive(data, _RATIO)
    arrays = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    grids = {name: info for name, info in arrays.items() if len(_header(archive, info)[0]) == 3}
    if len(grids) != 1:
        raise MeshInvalid(
            f"expected one array of three dimensions in the NPZ file, got {len(grids)} among "
            f"{', '.join(arrays)!s:.80}"
        )
    (grid,) = grids.values()
    check_cells(_header(archive, grid)[0])
    values, level, outside = _levels(_array(archive, grid))
    corner = -0.5 * np.array(values.shape) / max(values.shape)
    scale = 1.0
    if {"translate", "scale"} <= arrays.keys():
        corner = _numbers(archive, arrays["translate"], 3)
        scale = float(_numbers(archive, arrays["scale"], 1)[0])
    polygons = _placed(values, level, outside, corner, scale, limits)
    if not {"translate", "scale"} <= arrays.keys():
        polygons.warnings = (
            "the NPZ file has no translate and scale: its grid was placed around the origin, its longest "
            "side 1, its axes x, y, z",
        )
    return polygons


def _placed(
    values: NDArray[Any], level: float, outside: float, corner: Floats, scale: float, limits: MeshLimits
) -> Polygons:
    if corner.shape != (3,) or not (np.isfinite(corner).all() and np.isfinite(scale) and scale > 0):
        raise MeshInvalid("expected three finite numbers to translate the grid by and a positive scale")
    step = np.full(3, scale / max(values.shape))
    return isosurface(values, level, outside, corner + 0.5 * step, step, limits)


def _levels(values: NDArray[Any]) -> tuple[NDArray[Any], float, float]:
    """The values with the inside above a level, that level, and what lies outside."""
    if values.dtype.kind in "bui":
        return values != 0, 0.5, 0.0
    if not np.isfinite(values).all():
        raise MeshInvalid("expected finite values in the grid, got NaN or infinity")
    if values.min() >= 0:
        if values.max() > 1:
            raise MeshInvalid(
                "expected occupancies from 0 to 1 or signed distances in the grid, "
                f"got up to {values.max():g}"
            )
        return values, 0.5, 0.0
    signed = -values if border_mean(values > 0) > 0.5 else values
    return signed, 0.0, float(-np.abs(values).max())


def _header(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array, from its first bytes; they agree with the size of the member."""
    head = io.BytesIO(member_head(archive, info, _MAX_HEADER))
    version = npy.read_magic(head)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(head)
    if dtype.hasobject or dtype.kind not in "buif":
        raise MeshInvalid(
            f"expected arrays of numbers in the NPZ file, got {dtype!s:.40} in {info.filename!r:.40}"
        )
    cells = 1
    for side in shape:
        cells *= side
    if head.tell() + cells * dtype.itemsize != info.file_size:
        raise MeshInvalid(
            f"truncated or damaged NPZ file: {info.filename!r:.40} has not the size it announces"
        )
    return shape, dtype


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    content = io.BytesIO(member_content(archive, info))
    values: NDArray[Any] = npy.read_array(content, allow_pickle=False)
    return values


def _numbers(archive: zipfile.ZipFile, info: zipfile.ZipInfo, count: int) -> Floats:
    shape, _ = _header(archive, info)
    if int(np.prod(shape)) != count:
        raise MeshInvalid(f"expected {count} numbers in {info.filename!r:.40}, got {shape!s:.40}")
    return _array(archive, info).astype(np.float64).ravel()
