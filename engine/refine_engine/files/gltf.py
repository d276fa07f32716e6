"""A glTF 2.0 document: its JSON, its bytes, and typed access to accessors. Knows nothing of meshes.

GLB and glTF with embedded data are read; all buffers are laid one after another into one, so that a document
is always written as one GLB. Source: the Khronos glTF 2.0 specification.
"""

from __future__ import annotations

import base64
import binascii
import copy
import json
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refine_proto.formats import GLB_MAGIC

from ..errors import FormatUnsupported, MeshInvalid
from .beside import Beside, stays_inside

Json = dict[str, Any]
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
_MAX_VALUES = 1_000_000  # of the JSON: each costs up to a few hundred bytes, however few it has in the file
_MAX_EMBEDDED = 512 << 20  # bytes of the files that a glTF refers to, each as often as it does
_MAX_DEPTH = 100  # of the JSON: far below where Python's recursion ends, on reading, copying or writing
# What hides or multiplies geometry. Any other extension is left as it is.
_REFUSED = {
    "EXT_meshopt_compression": "meshopt compression",
    "KHR_meshopt_compression": "meshopt compression",
    "EXT_mesh_gpu_instancing": "GPU instancing",
}


@dataclass
class Document:
    """A glTF document with one buffer. `chunks` are GLB chunks of unknown type, kept as they came.

    `warnings` say what of the file was left out.
    """

    json: Json
    binary: bytearray
    chunks: bytes = b""
    warnings: tuple[str, ...] = ()

    def copy(self) -> Document:
        return Document(copy.deepcopy(self.json), bytearray(self.binary), self.chunks, self.warnings)

    def item(self, kind: str, index: object) -> Json:
        """The object number `index` of the top-level array `kind`."""
        items = self.json.get(kind, [])
        if type(index) is not int or not 0 <= index < len(items):
            raise MeshInvalid(
                f"malformed glTF: expected an index of {kind} below {len(items)}, got {index!r:.40}"
            )
        found = items[index]
        if not isinstance(found, dict):
            raise MeshInvalid(f"malformed glTF: expected an object at {kind}[{index}], got {found!r:.40}")
        return found

    def elements(self, accessor: Json) -> NDArray[Any]:
        """The stored elements (count, components) as a writable view of the buffer, without sparse
        changes."""
        dtype, components, count = _layout(accessor)
        return self._view(accessor, dtype, components, count)

    def element_bytes(self, accessor: Json, of: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The bytes (count, size) of an accessor's elements as a view of `of`, an array as long as the
        buffer."""
        dtype, components, count = _layout(accessor)
        size = components * dtype.itemsize
        start, stride = self._span(accessor, size, count)
        return np.ndarray((count, size), np.uint8, of.data, start, (stride, 1))

    def read(self, index: object) -> NDArray[Any]:
        """The elements (count, components) of an accessor, sparse changes applied; normalised integers as
        float64."""
        accessor = self.item("accessors", index)
        dtype, components, count = _layout(accessor)
        if "bufferView" in accessor:
            elements = self._view(accessor, dtype, components, count).copy()
        else:
            if count > len(self.binary):  # what the file does not hold must not cost more than what it holds
                raise MeshInvalid(
                    f"malformed glTF: {count} elements without data in a buffer of {len(self.binary)} bytes"
                )
            elements = np.zeros((count, components), dtype)
        if sparse := accessor.get("sparse"):
            changes = natural(sparse, "count")
            at = self._view(sparse["indices"], np.dtype(_dtype(sparse["indices"])), 1, changes)[:, 0].astype(
                np.int64
            )
            if changes and (at.min() < 0 or at.max() >= count):
                raise MeshInvalid(
                    f"malformed glTF: sparse index {at.max()} in an accessor of {count} elements"
                )
            elements[at] = self._view(sparse["values"], dtype, components, changes)
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(elements / np.iinfo(dtype).max, -1.0)
        return elements

    def _view(self, part: Json, dtype: np.dtype[Any], components: int, count: int) -> NDArray[Any]:
        start, stride = self._span(part, components * dtype.itemsize, count)
        return np.ndarray((count, components), dtype, self.binary, start, (stride, dtype.itemsize))

    def _span(self, part: Json, size: int, count: int) -> tuple[int, int]:
        """First byte and stride of `count` elements of `size` bytes, proven to lie inside the buffer."""
        view = self.item("bufferViews", part.get("bufferView"))
        start, stop = self._extent(view)
        offset, stride = natural(part, "byteOffset", 0), natural(view, "byteStride", size)
        if stride < size:
            raise MeshInvalid(f"malformed glTF: byteStride {stride} for elements of {size} bytes")
        if count == 0:
            return 0, size
        end = offset + stride * (count - 1) + size
        if end > stop - start:
            raise MeshInvalid(
                f"malformed glTF: an accessor of {count} elements needs {end} bytes, "
                f"its view has {stop - start}"
            )
        return start + offset, stride

    def append(self, values: NDArray[Any], *, target: int = ARRAY_BUFFER, bounds: bool = False) -> int:
        """Add elements (count, components) in a bufferView of their own; returns the accessor's index."""
        code = next(code for code, dtype in _DTYPES.items() if np.dtype(dtype) == values.dtype)
        accessor: Json = {
            "bufferView": self.append_bytes(np.ascontiguousarray(values).tobytes(), target=target),
            "componentType": code,
            "count": len(values),
            "type": TYPES[values.shape[1]],
        }
        self.json.setdefault("accessors", []).append(accessor)
        if bounds:
            set_bounds(accessor, values)
        return len(self.json["accessors"]) - 1

    def fill(self, accessor: Json, values: NDArray[Any], *, bounds: bool = False) -> None:
        """Store elements (count, components) for an accessor that has none, in its component type."""
        dtype, components, count = _layout(accessor)
        if values.shape != (count, components):
            raise MeshInvalid(
                f"malformed glTF: expected {count} elements of {components} components, got {values.shape}"
            )
        stored = np.ascontiguousarray(values.astype(dtype))
        accessor["bufferView"], accessor["byteOffset"] = self.append_bytes(stored.tobytes()), 0
        if bounds and count:
            set_bounds(accessor, stored)

    def view_bytes(self, index: int) -> bytes:
        """The content of a bufferView."""
        view = self.item("bufferViews", index)
        start, end = self._extent(view)
        return bytes(self.binary[start:end])

    def _extent(self, view: Json) -> tuple[int, int]:
        """First byte of a bufferView and the byte behind it, proven to lie inside the buffer."""
        start, length = natural(view, "byteOffset", 0), natural(view, "byteLength")
        if start + length > len(self.binary):
            raise MeshInvalid(
                f"malformed glTF: a bufferView ends at {start + length}, its buffer has {len(self.binary)}"
            )
        return start, start + length

    def append_bytes(self, data: bytes, **view: Any) -> int:
        """Add a bufferView; returns its index."""
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        views = self.json.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **view})
        self.binary.extend(data)
        return len(views) - 1

    def to_glb(self) -> bytes:
        head = {key: value for key, value in self.json.items() if key != "buffers"}
        if self.binary:
            first = (self.json.get("buffers") or [{}])[0]
            head["buffers"] = [{**first, "byteLength": len(self.binary)}]
        text = json.dumps(head, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        # A name may hold half of a surrogate pair. UTF-8 has no bytes for it, JSON has an escape.
        body = _chunk(_JSON_CHUNK, text.encode(errors="backslashreplace"), b" ")
        if self.binary:
            body += _chunk(_BINARY_CHUNK, bytes(self.binary), b"\0")
        body += self.chunks
        return struct.pack("<4sII", GLB_MAGIC, 2, 12 + len(body)) + body


def parse(data: bytes, beside: Beside | None = None) -> Document:
    """Read a GLB or a glTF. Files that it refers to come from `beside`, and become part of the document."""
    data, behind = _split_behind(data) if data[:4] == GLB_MAGIC else (data, 0)
    chunks = list(_glb_chunks(data)) if data[:4] == GLB_MAGIC else [(_JSON_CHUNK, data)]
    if not chunks or chunks[0][0] != _JSON_CHUNK:
        raise MeshInvalid("malformed GLB: expected its first chunk to be JSON")
    document = _parse_json(chunks[0][1])
    has_binary = len(chunks) > 1 and chunks[1][0] == _BINARY_CHUNK
    rest = b"".join(struct.pack("<II", len(body), kind) + body for kind, body in chunks[1 + has_binary :])
    _refuse_unsupported(document)
    warnings = _embed_files(document, beside or (lambda uri: None))
    if behind:
        warnings.append(f"{behind} bytes behind the end of the GLB were left out")
    binary = _join_buffers(document, chunks[1][1] if has_binary else None)
    return Document(document, binary, rest, tuple(warnings))


def set_bounds(accessor: Json, values: NDArray[Any]) -> None:
    accessor["min"] = [float(x) for x in values.min(0)]
    accessor["max"] = [float(x) for x in values.max(0)]


def _split_behind(data: bytes) -> tuple[bytes, int]:
    """The GLB as long as its header says, and how many bytes lie behind it."""
    if len(data) < 20:
        raise MeshInvalid(f"truncated GLB: expected a header of at least 20 bytes, got {len(data)}")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise FormatUnsupported(f"expected GLB version 2, got {version}; export as glTF 2.0")
    if not 20 <= length <= len(data):
        raise MeshInvalid(f"truncated or damaged GLB: its header says {length} bytes, got {len(data)}")
    return data[:length], len(data) - length


def _glb_chunks(data: bytes) -> Iterator[tuple[int, bytes]]:
    at, length = 12, len(data)
    while at < length:
        if at + 8 > length:
            raise MeshInvalid("truncated GLB: a chunk header is cut off")
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise MeshInvalid(f"truncated GLB: a chunk of {size} bytes starts at byte {at + 8} of {length}")
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size


def _parse_json(text: bytes) -> Json:
    """Only what can be copied and written again: a failure after the optimisation would cost minutes."""

    def finite(number: str) -> float:
        if not math.isfinite(value := float(number)):
            raise ValueError(f"expected a number within the range of float64, got {number[:40]}")
        return value

    if sum(text.count(mark) for mark in (b",", b"[", b"{")) > _MAX_VALUES:
        raise MeshInvalid(f"expected at most {_MAX_VALUES} values in the JSON of the glTF, got more")
    try:
        document = json.loads(text.decode("utf-8-sig"), parse_float=finite, parse_constant=finite)
    except (ValueError, RecursionError) as error:
        raise MeshInvalid(f"malformed glTF: expected JSON ({error!s:.80})") from error
    if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
        raise MeshInvalid("malformed glTF: expected a JSON object with an asset")
    if _is_deep(document):
        raise MeshInvalid(f"expected at most {_MAX_DEPTH} levels of arrays and objects in the glTF, got more")
    if str(document["asset"].get("version", "")).partition(".")[0] != "2":
        raise FormatUnsupported(f"expected glTF version 2.0, got {document['asset'].get('version')!r:.20}")
    return document


def _is_deep(document: Json) -> bool:
    level: list[Json | list[Any]] = [document]
    for _ in range(_MAX_DEPTH):
        values = [item.values() if isinstance(item, dict) else item for item in level]
        level = [child for children in values for child in children if isinstance(child, dict | list)]
    return bool(level)


def _extensions_in_use(document: Json) -> Iterator[str]:
    """What the data is stored with; `extensionsUsed` alone names what may long be undone."""
    yield from document.get("extensionsRequired", [])
    for mesh in document.get("meshes", []):
        for primitive in mesh.get("primitives", []):
            yield from primitive.get("extensions", {})
    for kind in ("bufferViews", "nodes"):
        for item in document.get(kind, []):
            yield from item.get("extensions", {})


def _refuse_unsupported(document: Json) -> None:
    for name in _extensions_in_use(document):
        if name in _REFUSED:
            raise FormatUnsupported(f"{_REFUSED[name]} ({name}) is not supported; export the mesh without it")


def _embed_files(document: Json, beside: Beside) -> list[str]:
    """Every reference to an outside file as a `data:` URI. An image that is not there stays a reference.

    Returns a warning about those.
    """
    total, missing = 0, list[str]()
    for kind in ("buffers", "images"):
        for item in document.get(kind, []):
            uri = item.get("uri")
            if uri is None or str(uri).startswith("data:"):
                continue
            content = beside(str(uri))
            if content is None and kind == "images" and stays_inside(str(uri)):
                missing.append(f"{uri!r:.60}")
                continue
            if content is None:
                raise FormatUnsupported(
                    f"expected embedded data, got the outside file {uri!r:.60}; export as .glb, "
                    "put it beside the mesh, or send both in a .zip"
                )
            if (total := total + len(content)) > _MAX_EMBEDDED:
                raise MeshInvalid(f"expected at most {_MAX_EMBEDDED} bytes in the files of a glTF, got more")
            media = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp", ".png": "image/png"}
            suffix = PurePosixPath(str(uri)).suffix.lower()
            kind_of_data = media.get(suffix, "application/octet-stream")
            item["uri"] = f"data:{kind_of_data};base64,{base64.b64encode(content).decode()}"
    if not missing:
        return []
    return [
        f"{len(missing)} images are not there (first: {missing[0]}); the result refers to them as the file "
        "did: put them beside it, or send all in a .zip"
    ]


def _join_buffers(document: Json, chunk: bytes | None) -> bytearray:
    """All buffers one after another; the bufferViews of `document` are moved along."""
    buffers, binary, starts = document.get("buffers", []), bytearray(), []
    for number, buffer in enumerate(buffers):
        length = natural(buffer, "byteLength")
        if "uri" in buffer:
            content = _decode_uri(buffer.pop("uri"))
        elif number == 0 and chunk is not None:
            content = chunk
        else:
            raise MeshInvalid(f"malformed glTF: buffer {number} has no data")
        if len(content) < length:
            raise MeshInvalid(
                f"truncated glTF: buffer {number} should have {length} bytes, got {len(content)}"
            )
        binary.extend(b"\0" * (-len(binary) % 4))
        starts.append(len(binary))
        binary.extend(content[:length])
    if len(buffers) > 1:
        for view in document.get("bufferViews", []):
            number = natural(view, "buffer")
            if number >= len(buffers):
                raise MeshInvalid(f"malformed glTF: expected a buffer below {len(buffers)}, got {number}")
            view["byteOffset"] = natural(view, "byteOffset", 0) + starts[number]
            view["buffer"] = 0
    return binary


def _decode_uri(uri: str) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma or not head.endswith(";base64"):
        raise FormatUnsupported(f"expected a base64 data URI, got {uri!r:.40}")
    try:
        return base64.b64decode(body, validate=True)
    except (binascii.Error, ValueError) as error:
        raise MeshInvalid(f"malformed glTF: a data URI is not base64 ({error})") from error


def _layout(accessor: Json) -> tuple[np.dtype[Any], int, int]:
    kind = accessor.get("type")
    if kind not in _COMPONENTS:
        raise MeshInvalid(f"malformed glTF: unexpected accessor type {kind!r:.20}")
    return np.dtype(_dtype(accessor)), _COMPONENTS[kind], natural(accessor, "count")


def _dtype(part: Json) -> str:
    code = part.get("componentType")
    if code not in _DTYPES:
        raise MeshInvalid(f"malformed glTF: unknown componentType {code!r:.20}")
    return _DTYPES[code]


def natural(part: Json, key: str, default: int | None = None) -> int:
    value = part.get(key, default)
    if type(value) is not int or value < 0:
        raise MeshInvalid(f"malformed glTF: expected a whole number for {key}, got {value!r:.40}")
    return value


def _chunk(kind: int, body: bytes, padding: bytes) -> bytes:
    body += padding * (-len(body) % 4)
    return struct.pack("<II", len(body), kind) + body
