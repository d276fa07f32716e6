"""A small GLB writer for the tests, independent of the reader it tests."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Glb:
    """Collects JSON and bytes. `add` returns an accessor's index."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }
        self.binary = b""

    def view(self, data: bytes, **extra: Any) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **extra}
        )
        self.binary += data
        return len(self.json["bufferViews"]) - 1

    def add(self, values: Any, dtype: str = "f4", **extra: Any) -> int:
        array = np.asarray(values, "<" + dtype)
        array = array.reshape(len(array), -1)
        accessor = {
            "bufferView": self.view(array.tobytes()),
            "componentType": CODES[dtype],
            "count": len(array),
            "type": TYPES[array.shape[1]],
        }
        if dtype == "f4" and array.shape[1] == 3 and len(array):
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.json["accessors"].append(accessor | extra)
        return len(self.json["accessors"]) - 1

    def mesh(self, positions: Any, faces: Any = None, **primitive: Any) -> dict[str, Any]:
        """Append a mesh of one primitive; returns the primitive."""
        made: dict[str, Any] = {"attributes": {"POSITION": self.add(positions)}}
        if faces is not None:
            made["indices"] = self.add(np.ravel(faces), "u2")
        made |= primitive
        self.json["meshes"].append({"primitives": [made]})
        return made

    def build(self) -> bytes:
        head = {**self.json}
        if self.binary:
            head["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(head).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text
        if self.binary:
            data = self.binary + b"\0" * (-len(self.binary) % 4)
            body += struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def accessor_values(data: bytes, index: int) -> NDArray[Any]:
    """Elements of a float accessor of a GLB, with its stride."""
    head, binary = split_glb(data)
    accessor = head["accessors"][index]
    view = head["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[accessor["type"]]
    stride = view.get("byteStride", 4 * width)
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    rows = [struct.unpack_from(f"<{width}f", binary, start + stride * i) for i in range(accessor["count"])]
    return np.array(rows, np.float32)


# A unit cube as 8 vertices and as 24 (one per face corner), wound outwards.
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CUBE_FACES = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])
_CORNERS = np.arange(24).reshape(6, 4)
SPLIT = CUBE[QUADS.ravel()]
SPLIT_FACES = np.concatenate([_CORNERS[:, [0, 1, 2]], _CORNERS[:, [0, 2, 3]]])
_SIDES = [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]]
NORMALS = np.repeat(np.array(_SIDES, np.float32), 4, axis=0)


class Tools:
    """What the tests share: the GLB writer and reader above, and a cube."""

    Glb = Glb
    split_glb = staticmethod(split_glb)
    values = staticmethod(accessor_values)
    cube, cube_faces = CUBE, CUBE_FACES
    split, split_faces, normals = SPLIT, SPLIT_FACES, NORMALS


@pytest.fixture(scope="session")
def tools() -> type[Tools]:
    return Tools


@pytest.fixture
def textured(tools: type[Tools]) -> bytes:
    """A cube with hard edges, UVs, tangents, a texture, names, extras, an animation, transformed nodes."""
    glb = tools.Glb()
    uv = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (6, 1)) * 0.9
    tangents = np.tile([1, 0, 0, 1], (24, 1))
    primitive = glb.mesh(tools.split, tools.split_faces, material=0)
    primitive["attributes"] |= {
        "NORMAL": glb.add(tools.normals),
        "TEXCOORD_0": glb.add(uv),
        "TANGENT": glb.add(tangents),
    }
    image = glb.view(bytes(range(97)))
    times, moves = glb.add([0.0, 1.0], min=[0], max=[1]), glb.add([[0, 0, 0], [1, 0, 0]])
    glb.json |= {
        "nodes": [
            {"name": "root", "scale": [2, 3, 4], "children": [1], "extras": {"age": 32}},
            {"name": "body \u00e9", "mesh": 0, "translation": [10, 0, 0], "rotation": [0, 0.6, 0, 0.8]},
        ],
        "images": [{"bufferView": image, "mimeType": "image/png", "name": "skin"}],
        "textures": [{"source": 0}],
        "materials": [{"name": "paint", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
                "samplers": [{"input": times, "output": moves}],
            }
        ],
        "extras": {"origin": "a network", "number": 0.1},
    }
    return glb.build()


@pytest.fixture
def shared_inputs() -> Callable[[str], list[Path]]:
    """Files of the inputs folder that lies beside the checkout, if it is there."""

    def find(kind: str) -> list[Path]:
        root = Path(os.environ.get("REFINE_SHARED", Path(__file__).parents[5] / "shared"))
        files = sorted(path for path in (root / "inputs" / kind).glob("*.*"))
        if not files:
            pytest.skip(f"no sample files in {root}")
        return files

    return find
