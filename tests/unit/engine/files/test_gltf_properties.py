"""glTF documents that hypothesis makes: what is read comes back, what is broken is refused."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from refine_engine.errors import InputError, MeshInvalid
from refine_engine.files.gltf import parse
from refine_engine.files.mesh_file import MeshFile, read_mesh

Path = tuple[str | int, ...]
LENGTHS = st.floats(-100, 100, width=32)


def read_or_refuse(data: bytes) -> MeshFile | str:
    """The file, or what was said about it."""
    try:
        return read_mesh(data, "a.glb")
    except InputError as error:
        return str(error)


def rich(tools: Any) -> Any:
    """A document with about everything that the reader follows: two placed meshes, one of them skinned, a
    tree of nodes, a sparse accessor, morph targets, an animation."""
    glb = tools.Glb()
    box = glb.mesh(tools.split, tools.split_faces, material=0)
    box["attributes"] |= {
        "NORMAL": glb.add(tools.normals),
        "TANGENT": glb.add(np.tile([1, 0, 0, 1], (24, 1))),
    }
    skinned = glb.mesh(tools.cube, tools.cube_faces)
    joints, weights = np.tile([0, 1, 0, 0], (8, 1)), np.tile([0.5, 0.5, 0, 0], (8, 1))
    skinned["attributes"] |= {"JOINTS_0": glb.add(joints, "u1"), "WEIGHTS_0": glb.add(weights)}
    skinned["targets"] = [{"POSITION": glb.add(tools.cube * 0)}]
    glb.json["accessors"][skinned["attributes"]["POSITION"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": glb.view(np.array([7], "<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": glb.view(np.array([[1, 1, 2]], "<f4").tobytes())},
    }
    bind = glb.add(np.tile(np.eye(4).ravel(), (2, 1)))
    glb.json |= {
        "nodes": [
            {"name": "root", "scale": [2, 3, 4], "children": [1, 2], "extras": {"age": 32}},
            {"mesh": 0, "translation": [10, 0, 0], "rotation": [0, 0.6, 0, 0.8]},
            {"mesh": 1, "skin": 0},
            {"matrix": np.eye(4).ravel().tolist()},
            {"translation": [0, 0, 1]},
        ],
        "scenes": [{"nodes": [0, 3, 4]}],
        "skins": [{"joints": [3, 4], "inverseBindMatrices": bind}],
        "materials": [{"name": "paint", "pbrMetallicRoughness": {"metallicFactor": 0.5}}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
                "samplers": [{"input": glb.add([0.0, 1.0]), "output": glb.add([[0, 0, 0], [1, 0, 0]])}],
            }
        ],
    }
    return glb


def paths(value: Any, at: Path = ()) -> list[Path]:
    """The way to each value inside a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for key, child in items for path in ((*at, key), *paths(child, (*at, key)))]


AWKWARD = [
    2**31,
    2**63,
    1e308,
    5121,
    5123,
    5125,
    5126,
    "VEC2",
    "MAT4",
    "data:;base64,AAAA",
    "\ud800",
    "POSITION",
]
LEAVES = (
    st.none() | st.booleans() | st.integers(-3, 40) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5) | st.sampled_from(AWKWARD)
)  # fmt: skip
KEYS = st.sampled_from(["mesh", "count", "bufferView", "attributes", "POSITION"])
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3), max_leaves=6
)


@given(st.data())
def test_any_change_of_a_document_is_refused_or_can_be_written(tools: Any, data: st.DataObject) -> None:
    glb = rich(tools)
    for _ in range(data.draw(st.integers(1, 3))):
        *way, last = data.draw(st.sampled_from(paths(glb.json)))
        owner = glb.json
        for key in way:
            owner = owner[key]
        if data.draw(st.booleans()):
            owner[last] = data.draw(VALUES)
        else:
            del owner[last]
    file = read_or_refuse(glb.build())
    if isinstance(file, str):
        assert "\n" not in file
        return
    written = file.with_vertices(file.mesh.vertices, torch.ones(len(file.mesh.vertices)))
    again = read_mesh(written, "b.glb").mesh
    torch.testing.assert_close(again.vertices, file.mesh.vertices)
    assert torch.equal(again.faces, file.mesh.faces)


@pytest.mark.parametrize(
    "extras", ["1e999", "-1e999", "[" * 101 + "]" * 101, '{"a":' * 400 + "1" + "}" * 400]
)
def test_what_could_not_be_written_again_is_refused_before_it_is_refined(extras: str) -> None:
    with pytest.raises(MeshInvalid, match=r"within the range of float64|at most 100 levels"):
        parse(b'{"asset": {"version": "2.0"}, "extras": %s}' % extras.encode())


@st.composite
def placed_meshes(draw: st.DrawFn) -> dict[str, Any]:
    """A mesh of random triangles, perhaps with normals and texture coordinates, under two nodes."""
    count = draw(st.integers(3, 9))
    faces = arrays(np.int64, (draw(st.integers(1, 8)), 3), elements=st.integers(0, count - 1))
    return {
        "positions": draw(arrays(np.float32, (count, 3), elements=LENGTHS)),
        "faces": draw(faces),
        "index_type": draw(st.sampled_from(["u1", "u2", "u4"])),
        "normals": draw(st.none() | st.just(np.tile(np.array([0, 1, 0], np.float32), (count, 1)))),
        "uv": draw(st.none() | st.just(np.linspace(0, 1, 2 * count, dtype=np.float32).reshape(count, 2))),
        "nodes": [
            {
                "translation": draw(st.tuples(LENGTHS, LENGTHS, LENGTHS)),
                "rotation": Rotation.random(rng=draw(st.integers(0, 1000))).as_quat().tolist(),
                "scale": draw(st.tuples(*[st.sampled_from([-2.0, -0.5, 0.25, 1.0, 3.0])] * 3)),
            }
            for _ in range(2)
        ],
    }


def world(nodes: list[dict[str, Any]], points: Any) -> Any:
    """Points (N, 3) of the child of two nodes in world space: p -> T + R S p, from the inside out."""
    for node in reversed(nodes):
        points = Rotation.from_quat(node["rotation"]).apply(points * node["scale"]) + node["translation"]
    return points


@given(placed_meshes(), st.integers(0, 2**32 - 1))
def test_a_moved_mesh_comes_back_and_all_else_stays(tools: Any, made: dict[str, Any], seed: int) -> None:
    glb = tools.Glb()
    primitive = glb.mesh(made["positions"])
    primitive["indices"] = glb.add(made["faces"].ravel(), made["index_type"])
    for name, values in (("NORMAL", made["normals"]), ("TEXCOORD_0", made["uv"])):
        if values is not None:
            primitive["attributes"][name] = glb.add(values)
    glb.json["nodes"] = [made["nodes"][0] | {"children": [1]}, made["nodes"][1] | {"mesh": 0}]
    file = read_or_refuse(glb.build())
    if isinstance(file, str):
        assert "coincide" in file
        return
    of_source = file.vertex_of_source.numpy()
    used = of_source >= 0
    expected = world(made["nodes"], made["positions"].astype(np.float64))
    np.testing.assert_allclose(file.mesh.vertices[of_source[used]], expected[used], rtol=1e-5, atol=1e-3)

    random = np.random.default_rng(seed)
    offset = torch.from_numpy(random.normal(size=file.mesh.vertices.shape).astype(np.float32))
    moved, confidence = file.mesh.vertices + offset, torch.rand(len(offset))
    refined = file.with_vertices(moved, confidence)
    old, new = copy.deepcopy(glb.json), tools.split_glb(refined)[0]
    attributes = new["meshes"][0]["primitives"][0]["attributes"]
    written = tools.values(refined, attributes["POSITION"])
    back = world(made["nodes"], written.astype(np.float64))
    np.testing.assert_allclose(back[used], moved[of_source[used]], rtol=1e-5, atol=1e-3)
    assert np.array_equal(written[~used], made["positions"][~used])
    sigma = tools.values(refined, attributes["_SYMMETRY_CONFIDENCE"])[:, 0]
    np.testing.assert_array_equal(sigma, np.where(used, confidence[of_source], 0))
    assert {key: new[key] for key in ("asset", "scene", "scenes", "nodes")} == {
        key: json.loads(json.dumps(old[key])) for key in ("asset", "scene", "scenes", "nodes")
    }
    if made["uv"] is not None:
        assert np.array_equal(tools.values(refined, attributes["TEXCOORD_0"]), made["uv"])
    if made["normals"] is not None:
        lengths = np.linalg.norm(tools.values(refined, attributes["NORMAL"]), axis=1)
        np.testing.assert_allclose(lengths, 1, atol=1e-5)
