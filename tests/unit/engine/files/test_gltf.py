from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest
import torch

from refine_engine.files.colour_scale import confidence_colours
from refine_engine.files.mesh_file import MeshFile, read_mesh


def displaced(file: MeshFile, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    size = len(file.mesh.vertices)
    offset = 0.1 * torch.randn(size, 3, generator=generator)
    return file.mesh.vertices + offset, torch.rand(size, generator=generator)


def test_nodes_place_their_meshes(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    glb.json["nodes"] = [
        {"children": [1], "matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 5, 6, 7, 1]},  # column-major
        {
            "mesh": 0,
            "translation": [1, 0, 0],
            "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)],
        },  # 90 about Z
    ]
    mesh = read_mesh(glb.build(), "a.glb").mesh
    torch.testing.assert_close(mesh.vertices, torch.tensor([[7.0, 6, 7], [7, 8, 7], [5, 6, 7]]))
    assert mesh.faces.tolist() == [[0, 1, 2]]


def test_only_positions_normals_tangents_bounds_and_confidence_change(tools: Any, textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    assert (len(file.mesh.vertices), len(file.mesh.faces), len(file.vertex_of_source)) == (8, 12, 24)
    vertices, confidence = displaced(file)
    refined = file.with_vertices(vertices, confidence)
    (old, old_bytes), (new, new_bytes) = tools.split_glb(textured), tools.split_glb(refined)

    behind_normals = 24 * 24 + 72  # POSITION, indices, NORMAL; then TEXCOORD_0, TANGENT
    for start, end in ((behind_normals, behind_normals + 24 * 8), (behind_normals + 24 * 24, len(old_bytes))):
        assert new_bytes[start:end] == old_bytes[start:end]
    assert new_bytes[288 : 288 + 72] == old_bytes[288 : 288 + 72]  # indices
    for key in [
        "scene",
        "scenes",
        "nodes",
        "images",
        "textures",
        "materials",
        "animations",
        "extras",
        "asset",
    ]:
        assert new[key] == old[key]
    assert new["bufferViews"][: len(old["bufferViews"])] == old["bufferViews"]
    for before, after in zip(old["accessors"], new["accessors"], strict=False):
        assert {k: v for k, v in before.items() if k not in ("min", "max")} == {
            k: v for k, v in after.items() if k not in ("min", "max")
        }
    attributes = new["meshes"][0]["primitives"][0]["attributes"]
    added = len(old["accessors"])
    assert attributes == {
        "POSITION": 0,
        "NORMAL": 2,
        "TEXCOORD_0": 3,
        "TANGENT": 4,
        "_SYMMETRY_CONFIDENCE": added,
    }
    written = tools.values(refined, 0)
    assert new["accessors"][0]["min"] == written.min(0).tolist()
    assert new["accessors"][0]["max"] == written.max(0).tolist()
    np.testing.assert_allclose(tools.values(refined, added)[:, 0], confidence[file.vertex_of_source])


def test_moved_vertices_come_back_through_the_node_transform(textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    vertices, confidence = displaced(file)
    again = read_mesh(file.with_vertices(vertices, confidence), "b.glb")
    torch.testing.assert_close(again.mesh.vertices, vertices, rtol=0, atol=1e-5)
    assert torch.equal(again.mesh.faces, file.mesh.faces)


def test_seam_copies_end_at_identical_positions(tools: Any, textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    written = tools.values(file.with_vertices(*displaced(file)), 0)
    for vertex in range(8):
        copies = written[file.vertex_of_source.numpy() == vertex]
        assert len(copies) == 3
        assert np.ptp(copies, axis=0).max() == 0


def test_an_unmoved_mesh_keeps_its_positions_and_hard_edges(tools: Any, textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    same = file.with_vertices(file.mesh.vertices, torch.ones(8))
    assert np.array_equal(tools.values(same, 0), tools.split)
    np.testing.assert_allclose(tools.values(same, 2), tools.normals, atol=1e-6)


def test_normals_follow_the_surface(tools: Any, textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    vertices = file.mesh.vertices.clone()
    vertices[:, 1] += vertices[:, 0]  # shear in world space: the x faces keep their normal, the y faces tilt
    normals = tools.values(file.with_vertices(vertices, torch.ones(8)), 2)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert np.ptp(normals.reshape(6, 4, 3), axis=1).max() < 1e-5  # each side is still flat
    assert abs(normals[12:16] - tools.normals[12:16]).max() > 0.2


def test_a_badly_wound_mesh_keeps_its_shading(tools: Any) -> None:
    glb, faces = tools.Glb(), tools.cube_faces.copy()
    faces[::2] = faces[::2, ::-1]
    outward = (tools.cube - 0.5) / np.linalg.norm(tools.cube - 0.5, axis=1, keepdims=True)
    primitive = glb.mesh(tools.cube, faces)
    primitive["attributes"]["NORMAL"] = glb.add(outward)
    file = read_mesh(glb.build(), "a.glb")
    normals = tools.values(file.with_vertices(file.mesh.vertices * 1.1, torch.ones(8)), 2)
    assert (normals * outward).sum(1).min() > 0.8


def test_interleaved_attributes_stay_in_their_lanes(tools: Any) -> None:
    glb = tools.Glb()
    uv = np.linspace(0, 1, 48, dtype=np.float32).reshape(24, 2)
    lanes = np.concatenate([uv, tools.split, tools.normals], 1).astype("<f4")
    view = glb.view(lanes.tobytes(), byteStride=32)
    for offset, kind in ((0, "VEC2"), (8, "VEC3"), (20, "VEC3")):
        glb.json["accessors"].append(
            {"bufferView": view, "byteOffset": offset, "componentType": 5126, "count": 24, "type": kind}
        )
    indices = glb.add(tools.split_faces.ravel(), "u1")
    attributes = {"TEXCOORD_0": 0, "POSITION": 1, "NORMAL": 2}
    glb.json["meshes"] = [{"primitives": [{"attributes": attributes, "indices": indices}]}]
    file = read_mesh(glb.build(), "a.glb")
    vertices, confidence = displaced(file)
    refined = file.with_vertices(vertices, confidence)
    assert np.array_equal(tools.values(refined, 0), uv)
    np.testing.assert_allclose(tools.values(refined, 1), vertices[file.vertex_of_source], atol=1e-6)
    assert len(tools.split_glb(refined)[1]) == len(glb.binary) + 24 * 4  # the confidence


def test_instances_of_one_mesh_are_refined_separately(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["meshes"][0]["name"] = "wheel"
    glb.json["nodes"] = [{"mesh": 0, "name": "left"}, {"mesh": 0, "name": "right", "translation": [5, 0, 0]}]
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    file = read_mesh(glb.build(), "a.glb")
    assert len(file.mesh.vertices) == 16
    vertices, confidence = displaced(file)
    refined = file.with_vertices(vertices, confidence)
    head, _ = tools.split_glb(refined)
    assert [node["mesh"] for node in head["nodes"]] == [0, 1]
    assert [mesh["name"] for mesh in head["meshes"]] == ["wheel", "wheel"]
    torch.testing.assert_close(read_mesh(refined, "b.glb").mesh.vertices, vertices, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
def test_index_widths(tools: Any, dtype: str) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube)["indices"] = glb.add(tools.cube_faces.ravel(), dtype)
    assert read_mesh(glb.build(), "a.glb").mesh.faces.tolist() == tools.cube_faces.tolist()


def test_missing_indices_strips_and_fans_give_the_same_square(tools: Any) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    for primitive, order in (
        ({}, [0, 1, 2, 2, 1, 3]),
        ({"mode": 5}, [0, 1, 2, 3]),
        ({"mode": 6}, [0, 1, 3, 2]),
    ):
        glb = tools.Glb()
        glb.mesh(corners[order], **primitive)
        mesh = read_mesh(glb.build(), "a.glb").mesh
        a, b, c = mesh.vertices[mesh.faces].unbind(1)
        areas = torch.linalg.cross(b - a, c - a)
        assert len(mesh.vertices) == 4
        assert areas.tolist() == [[0, 0, 1], [0, 0, 1]]


def test_sparse_and_quantised_positions_are_decoded_and_written_as_floats(tools: Any) -> None:
    sparse, quantised = tools.Glb(), tools.Glb()
    sparse.mesh(tools.cube, tools.cube_faces)
    sparse.json["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": sparse.view(np.array([7], "<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": sparse.view(np.array([[1, 1, 2]], "<f4").tobytes())},
    }
    position = quantised.add(np.round(tools.cube * 32767), "i2", normalized=True)
    indices = quantised.add(tools.cube_faces.ravel(), "u2")
    quantised.json["meshes"] = [{"primitives": [{"attributes": {"POSITION": position}, "indices": indices}]}]
    quantised.json["extensionsRequired"] = quantised.json["extensionsUsed"] = ["KHR_mesh_quantization"]
    for glb, last in ((sparse, [1, 1, 2]), (quantised, [1, 1, 1])):
        file = read_mesh(glb.build(), "a.glb")
        assert file.mesh.vertices[7].tolist() == last
        vertices, confidence = displaced(file)
        refined = file.with_vertices(vertices, confidence)
        assert tools.split_glb(refined)[1][: len(glb.binary)] == glb.binary  # not overwritten
        torch.testing.assert_close(read_mesh(refined, "b.glb").mesh.vertices, vertices, rtol=0, atol=1e-6)


def test_a_mirrored_node_keeps_the_front_outside(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0, "scale": [-1, 1, 1]}]
    mesh = read_mesh(glb.build(), "a.glb").mesh
    a, b, c = mesh.vertices[mesh.faces].double().unbind(1)
    assert float((a * torch.linalg.cross(b, c)).sum() / 6) == pytest.approx(1.0)  # positive volume


def test_a_skinned_mesh_is_placed_by_its_joints(tools: Any) -> None:
    glb = tools.Glb()
    primitive = glb.mesh(tools.cube, tools.cube_faces)
    joints = np.zeros((8, 4), int)
    joints[:, 1] = 1
    weights = np.zeros((8, 4))
    weights[:4, 0], weights[4:, 1] = 1, 1  # x = 0 follows joint 0, x = 1 follows joint 1
    primitive["attributes"] |= {"JOINTS_0": glb.add(joints, "u1"), "WEIGHTS_0": glb.add(weights)}
    bind = np.stack([np.eye(4), np.eye(4)])
    bind[1, 3, 0] = -1  # column-major: translation -1 in x
    glb.json["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},  # ignored for a skinned mesh
        {"translation": [0, 0, 1]},
        {"translation": [4, 0, 0]},
    ]
    glb.json["scenes"] = [{"nodes": [0, 1, 2]}]
    glb.json["skins"] = [{"joints": [1, 2], "inverseBindMatrices": glb.add(bind.reshape(2, 16))}]
    file = read_mesh(glb.build(), "a.glb")
    expected = tools.cube + np.where(np.arange(8)[:, None] < 4, [0, 0, 1], [3, 0, 0])
    np.testing.assert_allclose(file.mesh.vertices, expected, atol=1e-6)
    vertices, confidence = displaced(file)
    again = read_mesh(file.with_vertices(vertices, confidence), "b.glb")
    torch.testing.assert_close(again.mesh.vertices, vertices, rtol=0, atol=1e-5)


def test_unused_vertices_stay_and_take_no_part(tools: Any) -> None:
    glb = tools.Glb()
    stray = np.array([[50, 50, 50]], np.float32)
    glb.mesh(np.concatenate([stray, tools.cube]), tools.cube_faces + 1)
    file = read_mesh(glb.build(), "a.glb")
    assert file.mesh.vertices.shape == (8, 3)
    assert file.vertex_of_source.tolist() == [-1, *range(8)]
    written = tools.values(file.with_vertices(file.mesh.vertices + 1, torch.ones(8)), 0)
    assert written[0].tolist() == [50, 50, 50]
    assert np.array_equal(written[1:], tools.cube + 1)


def test_points_beside_triangles_are_left_alone(tools: Any) -> None:
    glb = tools.Glb()
    primitive = glb.mesh(tools.cube, tools.cube_faces)
    glb.json["meshes"][0]["primitives"].append({"attributes": dict(primitive["attributes"]), "mode": 0})
    file = read_mesh(glb.build(), "a.glb")
    assert "points or lines" in file.warnings[0]
    head, _ = tools.split_glb(file.with_vertices(*displaced(file)))
    triangles, points = head["meshes"][0]["primitives"]
    assert points["attributes"] == {"POSITION": 0}
    assert triangles["attributes"]["POSITION"] != 0
    assert head["accessors"][0]["max"] == [1, 1, 1]


def test_embedded_gltf_with_two_buffers_becomes_one_glb(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    half = glb.json["bufferViews"][1]["byteOffset"]
    glb.json["bufferViews"][1] |= {"buffer": 1, "byteOffset": 0}
    parts = [glb.binary[:half], glb.binary[half:]]
    glb.json["buffers"] = [
        {
            "uri": "data:application/octet-stream;base64," + base64.b64encode(part).decode(),
            "byteLength": len(part),
        }
        for part in parts
    ]
    file = read_mesh(json.dumps(glb.json).encode(), "a.gltf")
    vertices, confidence = displaced(file)
    refined = file.with_vertices(vertices, confidence)
    assert refined[:4] == b"glTF"
    torch.testing.assert_close(read_mesh(refined, "b.glb").mesh.vertices, vertices, rtol=0, atol=1e-6)


def test_a_name_that_utf8_has_no_bytes_for_stays(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"][0]["name"] = "half a pair \ud800, and \u00e9"
    file = read_mesh(glb.build(), "a.glb")
    head, _ = tools.split_glb(file.with_vertices(*displaced(file)))
    assert head["nodes"] == glb.json["nodes"]


def test_refining_twice_adds_nothing_the_second_time(textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    once = file.with_vertices(*displaced(file))
    twice_file = read_mesh(once, "b.glb")
    twice = twice_file.with_vertices(*displaced(twice_file, 1))
    assert abs(len(twice) - len(once)) < 200  # the bounds' digits


def test_a_mesh_far_from_the_origin_keeps_its_precision(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0, "translation": [1e6, 0, 0]}]
    file = read_mesh(glb.build(), "a.glb")
    moved = file.mesh.vertices.clone()
    moved[0, 1] += 0.25
    written = tools.values(file.with_vertices(moved, torch.ones(8)), 0)
    expected = tools.cube.copy()
    expected[0, 1] += 0.25
    assert np.array_equal(written, expected)


def test_other_sizes_are_a_programming_error(textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    with pytest.raises(ValueError, match=r"expected vertices \(8, 3\)"):
        file.with_vertices(torch.zeros(24, 3), torch.zeros(24))


def test_confidence_glb_is_unlit_in_linear_colours(tools: Any, textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    sigma = torch.linspace(0, 1, 8)
    data = file.confidence_glb(file.mesh.vertices, sigma)
    head, _ = tools.split_glb(data)
    assert head["extensionsUsed"] == ["KHR_materials_unlit"]
    assert head["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    colour = head["accessors"][head["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (colour["count"], colour["type"]) == (8, "VEC4")
    _, binary = tools.split_glb(data)
    start = head["bufferViews"][colour["bufferView"]]["byteOffset"]
    rgba = np.frombuffer(binary, "<f4", 32, start).reshape(8, 4)
    shown = np.where(rgba <= 0.0031308, rgba * 12.92, 1.055 * rgba ** (1 / 2.4) - 0.055)  # what a screen gets
    expected = confidence_colours(sigma.double().numpy())
    assert np.allclose(shown[:, :3], expected, atol=1e-5)
    assert (rgba[:, 3] == 1).all()
    assert "images" not in head
