"""OBJ, PLY, STL and OFF files as glTF documents, so that there is one way on from there.

trimesh parses the text and the binary layouts; nothing outside the given bytes is opened. Kept: vertices in
the file's order, polygons as triangles, vertex colours, vertex normals, one set of texture coordinates.
Material and texture files are not part of the bytes and are dropped.
"""

from __future__ import annotations

import io
import logging
import re
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..errors import MeshInvalid
from .gltf import ELEMENT_ARRAY_BUFFER, Document, Json
from .limits import MeshLimits, one_line
from .weld import weld

logging.getLogger("trimesh").addHandler(logging.NullHandler())
_OFF_HEADER = re.compile(rb"^\s*(?:ST|C|N|4|n)*OFF\s*(?:#[^\n]*\s+)*(\d+)\s+(\d+)", re.MULTILINE)


def read_polygons(data: bytes, kind: str, limits: MeshLimits) -> Document:
    """Read a file of `kind` obj, ply, stl or off. Raises MeshInvalid."""
    limits.check_source(*_announced(data, kind))
    expected_faces = None
    if kind == "obj":
        data, expected_faces = _absolute_obj(data)
    try:
        with np.errstate(all="ignore"):  # a colour that is NaN must not cost the mesh
            scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    except MemoryError:  # no fault of the file
        raise
    except Exception as error:  # a parser may fail in any way on damaged bytes
        raise MeshInvalid(f"damaged {kind.upper()} file: {one_line(error)}") from error
    geometries = [g for g in scene.geometry.values() if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not geometries:
        raise MeshInvalid(f"expected triangles or polygons in the {kind.upper()} file, got none")
    faces = sum(len(geometry.faces) for geometry in geometries)
    if expected_faces is not None and faces != expected_faces:
        raise MeshInvalid(f"damaged OBJ file: expected {expected_faces} triangles, could read only {faces}")
    limits.check_source(sum(len(geometry.vertices) for geometry in geometries), faces)
    has_normals = bool(
        re.search(rb"^vn\s" if kind == "obj" else rb"^property\s+\w+\s+nx\s", data, re.MULTILINE)
    )
    parts = [_part(geometry, has_normals) for geometry in geometries]
    return mesh_document([_joined(part) for part in parts] if kind == "stl" else parts)


def mesh_document(parts: list[dict[str, NDArray[Any]]], material: Json | None = None) -> Document:
    """A document of one mesh. Each part has `faces` (F, 3) and vertex attributes by their glTF names."""
    document = Document({"asset": {"version": "2.0", "generator": "refine-mesh"}}, bytearray())
    primitives: list[Json] = []
    for part in parts:
        attributes = {
            name: document.append(values, bounds=name == "POSITION")
            for name, values in part.items()
            if name != "faces"
        }
        if "COLOR_0" in part and part["COLOR_0"].dtype == np.uint8:
            document.item("accessors", attributes["COLOR_0"])["normalized"] = True
        faces = part["faces"].astype("<u4").reshape(-1, 1)
        primitives.append(
            {"attributes": attributes, "indices": document.append(faces, target=ELEMENT_ARRAY_BUFFER)}
            | ({"material": 0} if material else {})
        )
    if material:
        document.json["materials"] = [material]
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
    }
    return document


def _part(geometry: trimesh.Trimesh, has_normals: bool) -> dict[str, NDArray[Any]]:
    positions, faces = np.asarray(geometry.vertices, np.float64), np.asarray(geometry.faces)
    count = len(positions)
    if faces.min() < 0 or faces.max() >= count:
        raise MeshInvalid(f"expected face indices from 0 to {count - 1}, got {faces.min()} to {faces.max()}")
    if not (np.abs(positions) <= np.finfo(np.float32).max).all():
        raise MeshInvalid(f"expected finite vertex positions, got NaN or infinity in {_unusable(positions)}")
    # A zero normal stands for "none given"; moving the vertices computes them all.
    normals = np.asarray(geometry.vertex_normals) if has_normals else np.zeros((count, 3))
    part = {"POSITION": positions.astype("<f4"), "NORMAL": normals.astype("<f4"), "faces": faces}
    colours = getattr(geometry.visual, "vertex_colors", None) if _has_vertex_colours(geometry) else None
    if colours is not None and np.shape(colours) == (count, 4):
        part["COLOR_0"] = np.asarray(colours, np.uint8)
    uv = getattr(geometry.visual, "uv", None)
    if uv is not None and np.shape(uv) == (count, 2) and np.isfinite(uv).all():
        flipped = np.stack([uv[:, 0], 1.0 - uv[:, 1]], 1)  # glTF counts texture rows from the top
        part["TEXCOORD_0"] = flipped.astype("<f4")
    return part


def _has_vertex_colours(geometry: trimesh.Trimesh) -> bool:
    return geometry.visual is not None and geometry.visual.kind == "vertex"


def _unusable(positions: NDArray[np.float64]) -> str:
    bad = np.logical_not((np.abs(positions) <= np.finfo(np.float32).max).all(axis=1, keepdims=True))[:, 0]
    return f"{int(bad.sum())} of {len(bad)} vertices (first: {int(bad.argmax())})"


def _joined(part: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """STL gives every triangle its own corners and nothing else per corner: join them for good."""
    joined = weld(part["POSITION"].astype(np.float64), part["faces"])
    kept = {name: part[name][joined.source_of] for name in ("POSITION", "NORMAL")}
    return {**kept, "faces": joined.faces} if len(joined.faces) else part


def _announced(data: bytes, kind: str) -> tuple[int, int]:
    """Vertices and faces that the file says it has, before it is parsed."""
    if kind == "obj":
        return _count(rb"^\s*v\s", data), _count(rb"^\s*f\s", data)
    if kind == "stl":
        return 0, max((len(data) - 84) // 50 if _is_binary_stl(data) else _count(rb"^\s*facet\s", data), 0)
    if kind == "ply":
        header = data[: data.find(b"end_header")]
        element = rb"^element\s+%s\s+(\d+)"
        vertices, faces = (re.search(element % name, header, re.MULTILINE) for name in (b"vertex", b"face"))
        return _number(vertices), _number(faces)
    counts = _OFF_HEADER.search(data[:65536])
    return _number(counts), _number(counts, 2)


def _number(match: re.Match[bytes] | None, group: int = 1) -> int:
    return int(match[group][:18]) if match else 0


def _count(pattern: bytes, data: bytes) -> int:
    return sum(1 for _ in re.finditer(pattern, data, re.MULTILINE))


def _is_binary_stl(data: bytes) -> bool:
    return len(data) >= 84 and int.from_bytes(data[80:84], "little") * 50 + 84 == len(data)


def _absolute_obj(data: bytes) -> tuple[bytes, int]:
    """The OBJ with relative (negative) indices made absolute, and how many triangles its faces make.

    A negative index counts back from the last vertex *so far*, which trimesh takes for the last of the file.
    """
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    triangles = 0
    for number, line in enumerate(lines):
        words = line.partition(b"#")[0].split()
        if not words:
            continue
        if words[0] in counts:
            counts[words[0]] += 1
        elif words[0] == b"f":
            triangles += max(len(words) - 3, 0)
            if b"-" in line:
                corners = (_absolute_corner(corner, list(counts.values())) for corner in words[1:])
                lines[number] = b"f " + b" ".join(corners)
    return b"\n".join(lines), triangles


def _absolute_corner(corner: bytes, counts: list[int]) -> bytes:
    parts = corner.split(b"/")
    for slot, part in enumerate(parts[:3]):
        if part.startswith(b"-") and part[1:].isdigit():
            absolute = counts[slot] + 1 - int(part[1:][:18])
            if absolute < 1:
                raise MeshInvalid(
                    f"expected face indices from -{counts[slot]} to -1, got {part.decode()[:20]}"
                )
            parts[slot] = b"%d" % absolute
    return b"/".join(parts)
