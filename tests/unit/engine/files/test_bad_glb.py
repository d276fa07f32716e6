from __future__ import annotations

import base64
import json
import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from refine_engine.errors import FormatUnsupported, InputError, MeshInvalid
from refine_engine.files.mesh_file import MeshLimits, read_mesh


def changed(tools: Any, change: Callable[[Any], object]) -> bytes:
    """A cube whose document was changed."""
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    change(glb)
    data: bytes = glb.build()
    return data


def meshopt(glb: Any) -> None:
    glb.json["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {}}


def infinite(glb: Any) -> None:
    glb.binary = struct.pack("<f", float("inf")) + glb.binary[4:]


def not_a_number(glb: Any) -> None:
    glb.binary = struct.pack("<f", float("nan")) + glb.binary[4:]


def cycle(glb: Any) -> None:
    glb.json["nodes"] = [{"mesh": 0, "children": [1]}, {"children": [0]}]


def deep(glb: Any) -> None:
    depth = 2000  # deeper than Python's stack; its scale leaves the range of numbers
    glb.json["nodes"] = [{"children": [i + 1], "scale": [9, 9, 9]} for i in range(depth)] + [{"mesh": 0}]


def flat_node(glb: Any) -> None:
    glb.json["nodes"][0]["scale"] = [1, 0, 1]


def too_many_nodes(glb: Any) -> None:
    glb.json["nodes"] = [{"children": [i + 1]} for i in range(30_000)] + [{"mesh": 0}]


def too_many_primitives(glb: Any) -> None:
    glb.json["meshes"][0]["primitives"] *= 30_000


def too_many_instances(glb: Any) -> None:
    glb.json["nodes"] = [{"mesh": 0}] * 30_000
    glb.json["scenes"] = [{"nodes": list(range(30_000))}]


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (meshopt, FormatUnsupported, "meshopt"),
        (
            lambda g: g.json.update(images=[{"uri": "http://a.example/b.png"}]),
            FormatUnsupported,
            "outside file",
        ),
        (lambda g: g.json.update(images=[{"uri": "../../etc/passwd"}]), FormatUnsupported, "outside file"),
        (lambda g: g.json["asset"].update(version="1.0"), FormatUnsupported, "2.0"),
        (lambda g: g.json["meshes"][0].update(weights=[0.5]), FormatUnsupported, "morph"),
        (infinite, MeshInvalid, "finite"),
        (not_a_number, MeshInvalid, "finite"),
        (cycle, MeshInvalid, "cycle"),
        (deep, MeshInvalid, "transform"),
        (flat_node, MeshInvalid, "flattens"),
        (lambda g: g.json["nodes"][0].update(matrix=[*[1, 0, 0, 0] * 4]), MeshInvalid, "last row 0 0 0 1"),
        (too_many_nodes, MeshInvalid, "at most 20000 nodes"),
        (too_many_instances, MeshInvalid, "at most 20000 nodes"),
        (too_many_primitives, MeshInvalid, "at most 20000 primitives"),
        (lambda g: g.json["nodes"][0].update(mesh=1), MeshInvalid, "meshes"),
        (lambda g: g.json["nodes"][0].update(mesh=-1), MeshInvalid, "meshes"),
        (lambda g: g.json["nodes"][0].update(rotation=[1]), MeshInvalid, "malformed"),
        (lambda g: g.json.update(nodes="abc"), MeshInvalid, "malformed"),
        (lambda g: g.json["scenes"][0].update(nodes=[]), MeshInvalid, "without a mesh"),
        (lambda g: g.json["meshes"][0]["primitives"][0].update(mode=0), MeshInvalid, "points or lines"),
        (lambda g: g.json["meshes"][0]["primitives"][0].update(mode=1), MeshInvalid, "points or lines"),
        (lambda g: g.json["accessors"][0].update(count=4), MeshInvalid, "indices from 0 to 3"),
        (lambda g: g.json["accessors"][0].update(count=9), MeshInvalid, "its view has 96"),
        (lambda g: g.json["accessors"][0].update(byteOffset=4), MeshInvalid, "its view has 96"),
        (lambda g: g.json["accessors"][0].update(count=-5), MeshInvalid, "count"),
        (lambda g: g.json["accessors"][0].update(count=10**12), MeshInvalid, "at most"),
        (lambda g: g.json["accessors"][1].update(count=10**12), MeshInvalid, "at most"),
        (lambda g: g.json["accessors"][0].update(type="VEC2"), MeshInvalid, "components"),
        (lambda g: g.json["accessors"][1].update(componentType=5126), MeshInvalid, "malformed"),
        (lambda g: g.json["bufferViews"][0].update(byteLength=10**9), MeshInvalid, "bufferView ends"),
        (lambda g: g.json["bufferViews"][0].update(byteStride=4), MeshInvalid, "byteStride"),
        (
            lambda g: g.json["accessors"][0].pop("bufferView"),
            MeshInvalid,
            "coincide",
        ),  # all zero, by the standard
    ],
)
def test_refused_with_a_reason(
    tools: Any, change: Callable[[Any], object], error: type[InputError], says: str
) -> None:
    with pytest.raises(error, match=says) as caught:
        read_mesh(changed(tools, change), "a.glb")
    assert "\n" not in str(caught.value)


def test_a_container_that_lies_about_its_length(tools: Any) -> None:
    data = changed(tools, lambda g: None)
    for broken in (data[:-5], data[:12], data[:4], data[:8] + struct.pack("<I", 12) + data[12:]):
        with pytest.raises(MeshInvalid, match="GLB"):
            read_mesh(broken, "a.glb")
    with pytest.raises(FormatUnsupported, match="version 2"):
        read_mesh(data[:4] + struct.pack("<I", 1) + data[8:], "a.glb")
    with pytest.raises(MeshInvalid, match="JSON"):
        read_mesh(b"{" * 200_000, "a.gltf")
    with pytest.raises(MeshInvalid, match="JSON"):
        read_mesh(b'{"asset": {"version": "2.0"}, "x": NaN}', "a.gltf")


def test_bytes_behind_a_glb_are_left_out_with_a_warning(tools: Any) -> None:
    data = changed(tools, lambda g: None)
    for behind in (b"\0", b"\0\0\0\0", b"\r\n--boundary--"):
        file = read_mesh(data + behind, "a.glb")
        assert f"{len(behind)} bytes behind the end of the GLB" in file.warnings[0]
        vertices = file.mesh.vertices
        written = file.with_vertices(vertices, torch.ones(len(vertices)))
        assert not read_mesh(written, "a.glb").warnings


def test_limits_count_every_instance(tools: Any) -> None:
    def four(glb: Any) -> None:
        glb.json["nodes"] = [{"mesh": 0, "translation": [3 * i, 0, 0]} for i in range(4)]
        glb.json["scenes"] = [{"nodes": [0, 1, 2, 3]}]

    data = changed(tools, four)
    assert len(read_mesh(data, "a.glb", MeshLimits(max_vertices=32, max_faces=48)).mesh.faces) == 48
    with pytest.raises(MeshInvalid, match="at most 31 vertices after welding, got 32"):
        read_mesh(data, "a.glb", MeshLimits(max_vertices=31))
    with pytest.raises(MeshInvalid, match="at most 47 triangles, got 48"):
        read_mesh(data, "a.glb", MeshLimits(max_faces=47))


def samples(tools: Any, textured: bytes) -> list[tuple[str, bytes]]:
    cube: Any = trimesh.Trimesh(tools.cube, tools.cube_faces, process=False)
    exported = {kind: cube.export(file_type=kind) for kind in ("obj", "ply", "stl", "off", "stl_ascii")}
    plain = [("a." + kind[:3], d.encode() if isinstance(d, str) else d) for kind, d in exported.items()]
    head, binary = tools.split_glb(textured)
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    head["buffers"] = [{"byteLength": len(binary), "uri": uri}]
    return [("a.glb", textured), *plain, ("b.gltf", json.dumps(head).encode())]


def test_damaged_bytes_give_an_input_error_or_a_mesh(tools: Any, textured: bytes) -> None:
    """Truncated files, flipped bytes and replaced numbers: nothing but InputError may escape."""
    dice = random.Random(0)
    messages: list[str] = []
    for name, data in samples(tools, textured):
        for _ in range(150):
            broken = bytearray(data)
            for _ in range(dice.choice((1, 1, 3, 20))):
                broken[dice.randrange(len(broken))] = dice.choice((0, 255, 0x2D, 0x39, dice.randrange(256)))
            if dice.random() < 0.3:
                del broken[dice.randrange(1, len(broken)) :]
            try:
                file = read_mesh(bytes(broken), name)
            except InputError as error:
                messages.append(str(error))
                continue
            data_out = file.with_vertices(file.mesh.vertices, torch.ones(len(file.mesh.vertices)))
            assert np.isfinite(read_mesh(data_out, "b.glb").mesh.vertices.numpy()).all()
    assert len(messages) > 100
    assert not any("\n" in message for message in messages)
