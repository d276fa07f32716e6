"""OBJ, PLY, STL, OFF and voxel files as glTF documents, so that there is one way on from there.

Kept: vertices in the file's order, polygons as triangles, colours, vertex normals, one set of texture
coordinates, materials and textures as far as glTF has them. What is left out is told in a warning.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .beside import Beside
from .gltf import ELEMENT_ARRAY_BUFFER, Document, Json
from .limits import MeshLimits
from .materials import MATTE, Material, MaterialFiles, media_type
from .obj import read_obj
from .off import read_off
from .ply import read_ply
from .stl import read_stl
from .surface import Part, Polygons
from .voxels import read_binvox, read_npz
from .weld import weld

_READERS: dict[str, Callable[[bytes, MeshLimits], Polygons]] = {
    "obj": read_obj,
    "off": read_off,
    "ply": read_ply,
    "stl": read_stl,
    "binvox": read_binvox,
    "npz": read_npz,
}
_UTF8_MARK = b"\xef\xbb\xbf"


def read_polygons(data: bytes, kind: str, limits: MeshLimits, beside: Beside | None = None) -> Document:
    """Read a file of `kind` (a key of _READERS); its materials come from `beside`. Raises MeshInvalid."""
    with np.errstate(all="ignore"):  # a colour that is NaN must not cost the mesh
        polygons = _READERS[kind](data.removeprefix(_UTF8_MARK), limits)
        parts = polygons.parts(limits)
    if kind == "stl":
        parts = {number: _joined(part) for number, part in parts.items()}
    material_of, told = _materials(polygons, parts, beside or (lambda uri: None))
    document = mesh_document([(part, material_of[number]) for number, part in parts.items()])
    document.warnings = (*polygons.warnings, *told)
    return document


def _materials(
    polygons: Polygons, parts: dict[int, Part], beside: Beside
) -> tuple[dict[int, Material], list[str]]:
    """The material of each part, and what was left out."""
    files = MaterialFiles(beside)
    if polygons.texture is not None:
        material_of = dict.fromkeys(parts, files.textured(polygons.texture))
    else:
        found = files.named(polygons.materials, polygons.libraries)
        names = dict(enumerate(polygons.materials))
        material_of = {number: found.get(names.get(number, ""), MATTE) for number in parts}
    bare = [number for number in parts if material_of[number].images and "TEXCOORD_0" not in parts[number]]
    told = files.warnings()
    if bare:
        told.append("textures were left out: the mesh has no texture coordinates for them")
    return material_of | {number: Material(material_of[number].json) for number in bare}, told


def mesh_document(parts: Sequence[tuple[Part, Material]]) -> Document:
    """A document of one mesh: of each part its `faces` (F, 3), its vertex attributes by their glTF names, and
    its material."""
    document = Document({"asset": {"version": "2.0", "generator": "refine-mesh"}}, bytearray())
    primitives: list[Json] = []
    number_of = {material: number for number, material in enumerate(dict.fromkeys(m for _, m in parts))}
    for part, material in parts:
        attributes = {
            name: document.append(values, bounds=name == "POSITION")
            for name, values in part.items()
            if name != "faces"
        }
        if "COLOR_0" in part and part["COLOR_0"].dtype == np.uint16:
            document.item("accessors", attributes["COLOR_0"])["normalized"] = True
        faces = part["faces"].astype("<u4").reshape(-1, 1)
        indices = document.append(faces, target=ELEMENT_ARRAY_BUFFER)
        primitives.append({"attributes": attributes, "indices": indices, "material": number_of[material]})
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
    }
    texture_of: dict[bytes, int] = {}
    document.json["materials"] = [
        material.to_json(
            {name: _texture(document, texture_of, data) for name, data in material.images.items()}
        )
        for material in number_of
    ]
    return document


def _texture(document: Document, texture_of: dict[bytes, int], image: bytes) -> int:
    """The index of a texture of this image, which is stored once."""
    if image not in texture_of:
        texture_of[image] = len(texture_of)
        view = document.append_bytes(image)
        entry = {"bufferView": view, "mimeType": media_type(image)}
        document.json.setdefault("images", []).append(entry)
        document.json.setdefault("textures", []).append({"source": texture_of[image]})
    return texture_of[image]


def _joined(part: Part) -> Part:
    """STL gives every triangle its own corners and nothing else per corner: join them for good."""
    joined = weld(part["POSITION"].astype(np.float64), part["faces"])
    kept = {name: part[name][joined.source_of] for name in ("POSITION", "NORMAL")}
    return {**kept, "faces": joined.faces} if len(joined.faces) else part
