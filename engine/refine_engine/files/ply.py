"""PLY, as text and binary: polygons or triangle strips, colours of vertices or faces, texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MeshInvalid
from .limits import MeshLimits
from .points import reconstruct
from .surface import Part, Polygons, colours, texture_coordinates
from .weld import Ints

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_RGB = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_LISTS = ("vertex_indices", "vertex_index")
_MAX_PROPERTIES = 200


@dataclass
class _Element:
    """Columns by property: an array (N,), or for a list (values, sizes (N,))."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(
        default_factory=list
    )  # name, type, type of a list's size
    columns: dict[str, Any] = field(default_factory=dict)


def read_ply(data: bytes, limits: MeshLimits) -> Polygons:
    """Read the polygons. Raises MeshInvalid, or ValueError for words that are no numbers."""
    order, elements, at = _header(data)
    named = {element.name: element for element in elements}
    counts = [named[name].count if name in named else 0 for name in ("vertex", "face")]
    limits.check_source(*counts)
    body = data[at:]
    if order:
        at = 0
        for element in elements:
            at = _read_binary(element, body, at, order)
    else:
        words, at = body.split(), 0
        for element in elements:
            at = _read_text(element, words, at)
    if "vertex" not in named:
        raise MeshInvalid("damaged PLY file: expected an element vertex, got none")
    polygons = _polygons(named, limits)
    polygons.texture = _texture(data[: data.find(b"end_header")])
    return polygons


def _texture(header: bytes) -> str | None:
    """The image that MeshLab and others name in a comment."""
    for line in header.decode("utf-8", "replace").splitlines():
        match line.split(None, 2):
            case ["comment", "TextureFile" | "texturefile", name]:
                return name.strip()
    return None


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, 100_000)
    line_end = data.find(b"\n", end)
    if end < 0 or line_end < 0:
        raise MeshInvalid("truncated PLY file: expected end_header within its first 100,000 bytes")
    order, elements = "", list[_Element]()
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", name, *_]:
                order = _ORDERS[name]
            case ["element", name, count]:
                elements.append(_Element(name, int(count[:20])))
                if elements[-1].count < 0:
                    raise MeshInvalid(f"damaged PLY file: expected a number of {name}, got {count[:20]}")
            case ["property", "list", size, kind, name]:
                elements[-1].properties.append((name, _TYPES[kind], _TYPES[size]))
            case ["property", kind, name]:
                elements[-1].properties.append((name, _TYPES[kind], None))
    if sum(len(element.properties) for element in elements) > _MAX_PROPERTIES:
        raise MeshInvalid(f"expected at most {_MAX_PROPERTIES} properties in the PLY file, got more")
    return order, elements, line_end + 1


def _read_text(element: _Element, words: list[bytes], at: int) -> int:
    width = len(element.properties)
    if not any(size for _, _, size in element.properties):
        stop = at + element.count * width
        if stop > len(words):
            raise MeshInvalid(_truncated(element))
        table = np.array(words[at:stop], np.float64).reshape(element.count, width)
        element.columns = {name: table[:, i] for i, (name, _, _) in enumerate(element.properties)}
        return stop
    found: list[list[Any]] = [[] for _ in range(2 * width)]
    if element.count * width > len(words) - at:
        raise MeshInvalid(_truncated(element))
    for _ in range(element.count):
        for i, (_, _, size) in enumerate(element.properties):
            if at >= len(words):
                raise MeshInvalid(_truncated(element))
            many = int(words[at]) if size else 1
            at += bool(size)
            if many < 0 or at + many > len(words):
                raise MeshInvalid(_truncated(element))
            found[2 * i].extend(words[at : at + many])
            found[2 * i + 1].append(many)
            at += many
    for i, (name, kind, size) in enumerate(element.properties):
        values = np.array(found[2 * i], np.int64 if size and kind[0] in "iu" else np.float64)
        element.columns[name] = (values, np.array(found[2 * i + 1], np.int64)) if size else values
    return at


def _read_binary(element: _Element, body: bytes, at: int, order: str) -> int:
    if not element.count or not element.properties:
        return at
    sizes = [_first_size(element, body, at, order, i) for i in range(len(element.properties))]
    rows = _rows(element, body, at, order, sizes)
    if rows is None:
        return _read_rows(element, body, at, order)
    for i, (name, _, size) in enumerate(element.properties):
        values = rows[f"v{i}"]
        if size:
            element.columns[name] = values.reshape(-1), np.full(element.count, sizes[i], np.int64)
        else:
            element.columns[name] = values.reshape(-1)
    return at + rows.nbytes


def _first_size(element: _Element, body: bytes, at: int, order: str, index: int) -> int:
    """How many values the property has in the first row; 1 if it is no list."""
    for i, (_, kind, size) in enumerate(element.properties):
        many = 1
        if size:
            many = int(_numbers(body, order + size, 1, at, element)[0])
            at += int(size[1])
        if i == index:
            return many
        at += many * int(kind[1])
    raise AssertionError


def _rows(element: _Element, body: bytes, at: int, order: str, sizes: list[int]) -> NDArray[Any] | None:
    """All rows at once, if every row has lists of the lengths of the first one."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for i, ((_, kind, size), many) in enumerate(zip(element.properties, sizes, strict=True)):
        if many < 0:
            raise MeshInvalid(f"damaged PLY file: a list of {many} values")
        fields += [(f"n{i}", order + size, ())] if size else []
        fields.append((f"v{i}", order + kind, (many,)))
    if sum(sizes) * 8 > len(body) - at + 8 * len(sizes):
        raise MeshInvalid(_truncated(element))
    record = np.dtype(fields)
    lists = [i for i, (_, _, size) in enumerate(element.properties) if size]
    if at + element.count * record.itemsize > len(body):
        if lists:
            return None
        raise MeshInvalid(_truncated(element))
    rows = np.frombuffer(body, record, element.count, at)
    return rows if all((rows[f"n{i}"] == sizes[i]).all() for i in lists) else None


def _read_rows(element: _Element, body: bytes, at: int, order: str) -> int:
    """Row by row, where lists differ in length."""
    least = sum(int((size or kind)[1]) for _, kind, size in element.properties)
    if at + element.count * least > len(body):
        raise MeshInvalid(_truncated(element))
    found: list[list[Any]] = [[] for _ in range(2 * len(element.properties))]
    for _ in range(element.count):
        for i, (_, kind, size) in enumerate(element.properties):
            many = 1
            if size:
                many = int(_numbers(body, order + size, 1, at, element)[0])
                at += int(size[1])
            found[2 * i].append(_numbers(body, order + kind, many, at, element))
            found[2 * i + 1].append(many)
            at += many * int(kind[1])
    for i, (name, _, size) in enumerate(element.properties):
        values = np.concatenate(found[2 * i])
        element.columns[name] = (values, np.array(found[2 * i + 1], np.int64)) if size else values
    return at


def _numbers(body: bytes, kind: str, many: int, at: int, element: _Element) -> NDArray[Any]:
    if many < 0 or at + many * int(kind[-1]) > len(body):
        raise MeshInvalid(_truncated(element))
    return np.frombuffer(body, kind, many, at)


def _truncated(element: _Element) -> str:
    return f"truncated PLY file: expected {element.count} of {element.name}, the data ends before"


def _polygons(named: dict[str, _Element], limits: MeshLimits) -> Polygons:
    vertex, face = named["vertex"], named.get("face", _Element("face", 0))
    positions = np.stack([np.asarray(vertex.columns[axis], np.float64) for axis in "xyz"], 1)
    lists = [face.columns[name] for name in _LISTS if isinstance(face.columns.get(name), tuple)]
    if strips := named.get("tristrips"):
        corners = _strips(*strips.columns["vertex_indices"])
        return Polygons(positions, corners, np.full(len(corners) // 3, 3), _of_vertex(vertex), {})
    if (not lists or not face.count) and "f_dc_0" in vertex.columns:
        raise MeshInvalid(
            f"expected triangles or points of a surface in the PLY file, got {vertex.count} Gaussian splats; "
            "make a mesh of them first"
        )
    if not lists or not face.count:
        return reconstruct(positions, _of_vertex(vertex), limits)
    corners, sizes = (np.asarray(part).astype(np.int64) for part in lists[0])
    of_vertex, warnings = _of_vertex(vertex), list[str]()
    of_corner: dict[str, tuple[NDArray[Any], Ints]] = {}
    if (found := _colours(face)) is not None:
        if "COLOR_0" in of_vertex:
            warnings.append("the file colours vertices and faces; the colours of the faces were left out")
        else:
            of_corner["COLOR_0"] = found, np.repeat(np.arange(len(sizes)), sizes)
    if isinstance(uv := face.columns.get("texcoord"), tuple):
        if np.array_equal(uv[1], 2 * sizes):
            values = texture_coordinates(np.asarray(uv[0], np.float64).reshape(-1, 2))
            distinct, which = np.unique(values, axis=0, return_inverse=True)
            of_corner["TEXCOORD_0"] = distinct, which.ravel().astype(np.int64)
            of_vertex.pop("TEXCOORD_0", None)
        else:
            warnings.append("some faces have no texture coordinates: they were left out")
    return Polygons(positions, corners, sizes, of_vertex, of_corner, warnings=tuple(warnings))


def _of_vertex(vertex: _Element) -> Part:
    part: Part = {}
    if all(name in vertex.columns for name in ("nx", "ny", "nz")):
        part["NORMAL"] = np.stack([vertex.columns[name] for name in ("nx", "ny", "nz")], 1).astype("<f4")
    if (found := _colours(vertex)) is not None:
        part["COLOR_0"] = found
    for names in _UV:
        if all(isinstance(vertex.columns.get(name), np.ndarray) for name in names):
            uv = np.stack([np.asarray(vertex.columns[name], np.float64) for name in names], 1)
            part["TEXCOORD_0"] = texture_coordinates(uv)
            break
    return part


def _colours(element: _Element) -> NDArray[np.uint16] | None:
    kinds = {name: kind for name, kind, size in element.properties if not size}
    for names in _RGB:
        if all(name in kinds for name in names):
            more = tuple(name for name in ("alpha",) if name in kinds)
            values = np.stack([np.asarray(element.columns[n], np.float64) for n in (*names, *more)], 1)
            kind = kinds[names[0]]
            full = (
                255.0
                if kind in ("u1", "i1")
                else 65535.0
                if kind == "u2"
                else 255.0
                if kind[0] in "iu"
                else 1.0
            )
            return colours(values, full)
    return None


def _strips(values: NDArray[Any], sizes: NDArray[Any]) -> NDArray[np.int64]:
    """The corners (3 T,) of triangle strips; -1 ends one and begins the next."""
    strip = np.asarray(values).astype(np.int64)
    owner = np.repeat(np.arange(len(sizes)), sizes)
    ends = strip < 0
    run = owner + np.cumsum(ends)
    start = np.zeros(len(strip), np.int64)  # where the run of each value begins
    fresh = np.flatnonzero(np.r_[True, run[1:] != run[:-1]]) if len(strip) else np.empty(0, np.int64)
    start[fresh] = fresh
    start = np.maximum.accumulate(start) + ends[np.maximum.accumulate(start)]
    at = np.arange(max(len(strip) - 2, 0))
    at = at[(run[at] == run[at + 2]) & ~ends[at]]
    odd = (at - start[at]) % 2 == 1
    corners = np.stack([strip[at], strip[at + 1 + odd], strip[at + 2 - odd]], 1)
    return corners.ravel()
