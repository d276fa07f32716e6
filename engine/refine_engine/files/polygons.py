"""OBJ, PLY, STL and OFF files as glTF documents, so that there is one way on from there.

Kept: vertices in the file's order, polygons as triangles, colours, vertex normals, one set of texture
coordinates. What is left out is told in a warning. Nothing outside the given bytes is opened.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .gltf import ELEMENT_ARRAY_BUFFER, Document, Json
from .limits import MeshLimits
from .obj import read_obj
from .off import read_off
from .ply import read_ply
from .stl import read_stl
from .surface import Part, Polygons
from .weld import weld

_READERS: dict[str, Callable[[bytes, MeshLimits], Polygons]] = {
    "obj": read_obj,
    "off": read_off,
    "ply": read_ply,
    "stl": read_stl,
}
_UTF8_MARK = b"\xef\xbb\xbf"
MATTE: Json = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}


def read_polygons(data: bytes, kind: str, limits: MeshLimits) -> Document:
    """Read a file of `kind` obj, ply, stl or off. Raises MeshInvalid."""
    with np.errstate(all="ignore"):  # a colour that is NaN must not cost the mesh
        polygons = _READERS[kind](data.removeprefix(_UTF8_MARK), limits)
        parts = polygons.parts(limits)
    document = mesh_document([_joined(part) for part in parts] if kind == "stl" else parts)
    document.warnings = polygons.warnings
    return document


def mesh_document(parts: list[Part], material: Json = MATTE) -> Document:
    """A document of one mesh, of one material.

    Each part has `faces` (F, 3) and vertex attributes by their glTF names.
    """
    document = Document({"asset": {"version": "2.0", "generator": "refine-mesh"}}, bytearray())
    primitives: list[Json] = []
    for part in parts:
        attributes = {
            name: document.append(values, bounds=name == "POSITION")
            for name, values in part.items()
            if name != "faces"
        }
        if "COLOR_0" in part and part["COLOR_0"].dtype == np.uint16:
            document.item("accessors", attributes["COLOR_0"])["normalized"] = True
        faces = part["faces"].astype("<u4").reshape(-1, 1)
        indices = document.append(faces, target=ELEMENT_ARRAY_BUFFER)
        primitives.append({"attributes": attributes, "indices": indices, "material": 0})
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": [material],  # glTF's default is bare metal: black in a viewer without surroundings
    }
    return document


def _joined(part: Part) -> Part:
    """STL gives every triangle its own corners and nothing else per corner: join them for good."""
    joined = weld(part["POSITION"].astype(np.float64), part["faces"])
    kept = {name: part[name][joined.source_of] for name in ("POSITION", "NORMAL")}
    return {**kept, "faces": joined.faces} if len(joined.faces) else part
