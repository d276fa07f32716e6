"""Draco-compressed primitives of a glTF document -> plain accessors (KHR_draco_mesh_compression)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatUnsupported, MeshInvalid
from .gltf import Document, Json, natural
from .gltf_geometry import TRIANGLES, triangle_primitives
from .limits import MeshLimits, one_line

DRACO = "KHR_draco_mesh_compression"
_MESH, _SEQUENTIAL, _EDGEBREAKER = 1, 0, 1  # in a header: what is encoded, and how its connectivity is
_METADATA = 0x8000  # a flag of the header


def decompress(document: Document, limits: MeshLimits) -> None:
    """Decode all triangle primitives in place; the compressed bytes stay in the buffer.

    The counts in the headers are held against `limits` before anything is decoded. Raises FormatUnsupported
    or MeshInvalid.
    """
    meshes: dict[int, Any] = {}  # decoded, by bufferView
    total = np.zeros(2, np.int64)
    for mesh in document.json.get("meshes", []):
        for primitive in triangle_primitives(mesh):
            extension = primitive.get("extensions", {}).pop(DRACO, None)
            if extension is None or _has_plain_data(document, primitive):
                continue
            view = natural(extension, "bufferView")
            if view not in meshes:
                data = document.view_bytes(view)
                total += _announced(data)
                limits.check_source(*total.tolist())
                meshes[view] = _decoded(data)
            _write(document, primitive, extension["attributes"], meshes[view])
    _forget(document.json)


def _has_plain_data(document: Document, primitive: Json) -> bool:
    """Whether the primitive is stored without compression too."""
    used = [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]
    return all("bufferView" in document.item("accessors", accessor) for accessor in used)


def _announced(data: bytes) -> tuple[int, int]:
    """Vertices and faces that the header of a Draco mesh announces."""
    if data[:5] != b"DRACO" or len(data) < 13:
        raise MeshInvalid(f"damaged Draco data: expected a header, got {data[:5]!r}")
    version, (kind, method), flags = (data[5], data[6]), data[7:9], int.from_bytes(data[9:11], "little")
    if version != (2, 2):
        raise FormatUnsupported(f"expected Draco 2.2, as glTF asks for, got {version[0]}.{version[1]}")
    if kind != _MESH or method not in (_SEQUENTIAL, _EDGEBREAKER) or flags & _METADATA:
        raise FormatUnsupported(
            "expected a Draco mesh without metadata, got something else; export without Draco"
        )
    first, at = _varint(data, 11 + (method == _EDGEBREAKER))  # behind the kind of traversal
    second, _ = _varint(data, at)
    return (first, second) if method == _EDGEBREAKER else (second, first)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of 7 bits a byte, and where the next one is."""
    value = 0
    for shift in range(0, 35, 7):
        if at >= len(data):
            break
        value |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return value, at
    raise MeshInvalid("damaged Draco data: its header is cut off")


def _decoded(data: bytes) -> Any:
    import DracoPy  # here: few files need it

    try:
        return DracoPy.decode(data)
    except MemoryError:  # no fault of the file
        raise
    except Exception as error:
        raise MeshInvalid(f"damaged Draco data: {one_line(error)}") from error


def _write(document: Document, primitive: Json, ids: Json, mesh: Any) -> None:
    """Give the accessors of a primitive the decoded data."""
    decoded = {entry["unique_id"]: entry["data"] for entry in mesh.attributes}
    faces = np.asarray(mesh.faces).reshape(-1, 1)
    for name, number in ids.items():
        if number not in decoded:
            raise MeshInvalid(f"damaged Draco data: it has no attribute {number!r:.20} for {name!r:.40}")
        if name not in primitive["attributes"]:
            raise MeshInvalid(f"malformed glTF: {name!r:.40} is in the Draco data and not in the primitive")
        _fill(document, primitive["attributes"][name], np.asarray(decoded[number]), bounds=name == "POSITION")
    if "indices" not in primitive:
        raise MeshInvalid("malformed glTF: expected indices of a primitive with Draco data, got none")
    _fill(document, primitive["indices"], faces)
    primitive["mode"] = TRIANGLES


def _fill(document: Document, accessor: object, values: NDArray[Any], *, bounds: bool = False) -> None:
    """Store the elements (count, components) of an accessor that has no data yet."""
    entry = document.item("accessors", accessor)
    if "bufferView" in entry:  # by another primitive that shares it
        if entry.get("count") != len(values):
            raise MeshInvalid(f"malformed glTF: accessor {accessor} belongs to Draco data of two sizes")
        return
    entry["count"] = len(values)
    document.fill(entry, values, bounds=bounds)


def _forget(json: Json) -> None:
    """Leave the extension out of the lists, unless points or lines still need it."""
    primitives = [p for mesh in json.get("meshes", []) for p in mesh.get("primitives", [])]
    for primitive in primitives:
        if primitive.get("extensions") == {}:
            del primitive["extensions"]
    if any(DRACO in primitive.get("extensions", {}) for primitive in primitives):
        return
    for key in ("extensionsUsed", "extensionsRequired"):
        if DRACO in json.get(key, []):
            json[key] = [name for name in json[key] if name != DRACO]
            if not json[key]:
                del json[key]
