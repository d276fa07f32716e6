"""glTF files with one odd thing in them: it is left alone and told, the rest is refined."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from refine_engine.errors import FormatUnsupported, MeshInvalid
from refine_engine.files.mesh_file import read_mesh


def moved(data: bytes) -> bytes:
    file = read_mesh(data, "a.glb")
    vertices = file.mesh.vertices + torch.tensor([0.0, 5.0, 0.0])
    return file.with_vertices(vertices, torch.ones(len(vertices)))


@pytest.mark.parametrize(
    "odd",
    [
        {"scale": [1, 1, 0]},
        {"scale": [0, 0, 0]},
        {"scale": [1e300, 1, 1], "children": [2]},
        {"extensions": {"KHR_node_visibility": {"visible": False}}},
        {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]},
    ],
)
def test_a_flat_or_invisible_node_is_left_as_it_is(tools: Any, odd: dict[str, Any]) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0}, {"mesh": 0, **odd}, {"mesh": 0, "scale": [1e300, 1, 1]}]
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    data = glb.build()
    file = read_mesh(data, "a.glb")
    assert len(file.mesh.vertices) == 8
    assert "invisible or flattened" in file.warnings[0]
    head = tools.split_glb(refined := moved(data))[0]
    used = [head["meshes"][node["mesh"]]["primitives"][0] for node in head["nodes"]]
    first, second = (tools.values(refined, part["attributes"]["POSITION"]) for part in used[:2])
    np.testing.assert_allclose(first, tools.cube + np.array([0, 5, 0]), atol=1e-6)
    np.testing.assert_array_equal(second, tools.cube)


def test_nothing_but_odd_nodes_is_refused(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}]
    with pytest.raises(MeshInvalid, match="invisible node"):
        read_mesh(glb.build(), "a.glb")


def test_another_scene_keeps_its_object(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0}, {"mesh": 0}]
    glb.json["scenes"] = [{"nodes": [0]}, {"nodes": [1]}]
    head = tools.split_glb(refined := moved(glb.build()))[0]
    other = head["meshes"][head["nodes"][1]["mesh"]]["primitives"][0]
    np.testing.assert_array_equal(tools.values(refined, other["attributes"]["POSITION"]), tools.cube)


def test_an_extension_that_is_only_listed_does_not_matter(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json |= {"extensionsUsed": ["EXT_meshopt_compression"], "asset": {"version": "2"}}
    assert len(read_mesh(glb.build(), "a.glb").mesh.vertices) == 8
    glb.json["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {"buffer": 0}}
    with pytest.raises(FormatUnsupported, match="meshopt"):
        read_mesh(glb.build(), "a.glb")


def test_what_the_file_does_not_hold_is_not_made(tools: Any) -> None:
    glb = tools.Glb()
    primitive = glb.mesh(tools.cube)
    glb.json["accessors"].append({"componentType": 5126, "count": 2_900_000, "type": "VEC3"})
    primitive["attributes"]["POSITION"] = 1
    with pytest.raises(MeshInvalid, match="without data"):
        read_mesh(glb.build(), "a.glb")


@pytest.mark.parametrize("value", [b"[]", b"{}", b"1", b'"a,b"'])
def test_json_of_too_many_values_is_refused_before_it_is_parsed(value: bytes) -> None:
    values = b"[" + value + (b"," + value) * 1_000_001 + b"]"
    with pytest.raises(MeshInvalid, match="at most 1000000 values"):
        read_mesh(b'{"asset": {"version": "2.0"}, "extras": ' + values + b"}", "a.gltf")
