from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from refine_engine.errors import FormatUnsupported, InputError, MeshInvalid
from refine_engine.files import gltf
from refine_engine.files.mesh_file import MeshLimits, read_mesh

SQUARE = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def loaded(data: bytes) -> Any:
    """What another program reads from a GLB."""
    scene: Any = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
    return scene.to_mesh()


def test_obj_keeps_its_vertex_order_and_polygons_become_triangles() -> None:
    mesh = read_mesh(SQUARE + b"f 1 2 3 4\n", "a.obj").mesh
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert len(mesh.faces) == 2


def test_obj_materials_groups_and_objects_keep_every_face() -> None:
    text = (
        b"mtllib absent.mtl\no one\nusemtl a\n"
        + SQUARE
        + b"vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nusemtl b\ng left\n"
        b"f 1 3 4\no two\nusemtl a\nv 0 0 1\nf 1 2 5\ng\nusemtl c\nf 2//  3// 5//\n"
    )
    file = read_mesh(text, "a.obj")
    assert (len(file.mesh.vertices), len(file.mesh.faces)) == (5, 4)
    assert len(loaded(file.with_vertices(file.mesh.vertices, torch.ones(5))).faces) == 4


def test_obj_relative_indices_count_from_the_vertices_so_far() -> None:
    two = TRIANGLE + b"f -3 -2 -1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"
    mesh = read_mesh(two, "a.obj").mesh
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_obj_texture_coordinates_survive_across_a_seam(tools: Any) -> None:
    uv = b"vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 0.5 0.25\n"
    text = SQUARE + uv + b"f 1/1 2/2 3/3\nf 1/5 3/3 4/4\n"  # vertex 1 has two texture coordinates
    file = read_mesh(text, "a.obj")
    assert (len(file.mesh.vertices), len(file.vertex_of_source)) == (4, 5)
    moved = file.mesh.vertices + torch.tensor([0.0, 0.0, 1.0])
    data = file.with_vertices(moved, torch.ones(4))
    attributes = tools.split_glb(data)[0]["meshes"][0]["primitives"][0]["attributes"]
    rows = np.concatenate([tools.values(data, attributes[name]) for name in ("POSITION", "TEXCOORD_0")], 1)
    # glTF counts the texture's rows from the top, OBJ from the bottom
    expected = {(0, 0, 1, 0, 1), (0, 0, 1, 0.5, 0.75), (1, 0, 1, 1, 1), (1, 1, 1, 1, 0), (0, 1, 1, 0, 0)}
    assert {tuple(row) for row in rows.tolist()} == expected


def test_ply_vertex_colours_survive(tools: Any) -> None:
    text = (
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        b"property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
        b"property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 0 255 0\n"
        b"0 1 0 0 0 200\n3 0 1 2\n"
    )
    file = read_mesh(text, "no suffix")
    document = gltf.parse(file.with_vertices(file.mesh.vertices, torch.ones(3)))
    rgba = document.read(document.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    # 200 of sRGB's 255 is 0.578 of the light, which is what glTF counts in
    expected = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.5776, 1.0]]
    np.testing.assert_allclose(rgba, expected, atol=1e-4)


def test_dark_vertex_colours_stay_apart(tools: Any) -> None:
    """8 bits of linear light would make one of the first 13 levels."""
    rows = "".join(f"v {i} {i % 2} {i % 3} {i / 255} 0 0\n" for i in range(12))
    file = read_mesh((rows + "".join(f"f {i} {i + 1} {i + 2}\n" for i in range(1, 11))).encode(), "a.obj")
    document = gltf.parse(file.with_vertices(file.mesh.vertices, torch.ones(12)))
    rgba = document.read(document.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    assert (np.diff(rgba[:, 0]) > 0).all()


def test_stl_corners_are_joined_for_good(tools: Any) -> None:
    cube: Any = trimesh.Trimesh(tools.cube, tools.cube_faces, process=False)
    file = read_mesh(cube.export(file_type="stl"), "a.stl")
    assert (len(file.mesh.vertices), len(file.mesh.faces)) == (8, 12)
    result = loaded(file.with_vertices(file.mesh.vertices, torch.ones(8)))
    assert len(result.vertices) == 8
    assert result.is_watertight


def test_off_with_comments_and_colours() -> None:
    text = b"OFF # a comment\n# another\n3 1 0\n0 0 0\n1 0 0 # here too\n0 1 0\n3 0 1 2 1.0 0.0 0.0\n"
    assert read_mesh(text, "a.off").mesh.faces.tolist() == [[0, 1, 2]]


def test_content_decides_before_the_name() -> None:
    glb = read_mesh(SQUARE + b"f 1 2 3\n", "a.obj")
    data = glb.with_vertices(glb.mesh.vertices, torch.ones(3))
    assert len(read_mesh(data, "wrong.obj").mesh.vertices) == 3


@pytest.mark.parametrize(
    ("data", "name", "error", "says"),
    [
        (b"", "a.glb", MeshInvalid, "empty file"),
        (b"", "a.obj", MeshInvalid, "empty file"),
        (b"\x89PNG\r\n", "a.png", FormatUnsupported, "expected a mesh file"),
        (b"Kaydara FBX", "a.fbx", FormatUnsupported, r"\.glb, \.gltf, \.obj"),
        (b"not a ply", "a.ply", MeshInvalid, "expected a PLY file"),
        (b"glTX1234", "a.glb", MeshInvalid, "expected a GLB file"),
        (TRIANGLE, "a.obj", MeshInvalid, "triangles"),
        (TRIANGLE + b"l 1 2\nl 2 3\n", "a.obj", MeshInvalid, "triangles"),
        (b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "a.obj", MeshInvalid, "finite"),
        (b"v 0 0 0\nv 1 0 0\nv 0 inf 0\nf 1 2 3\n", "a.obj", MeshInvalid, "finite"),
        (TRIANGLE + b"f 1 2 9\n", "a.obj", MeshInvalid, "OBJ"),
        (TRIANGLE + b"f 1 2 -9\n", "a.obj", MeshInvalid, "-3 to -1"),
        (TRIANGLE + b"f 1 2 x\n", "a.obj", MeshInvalid, "OBJ"),
        (b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "a.obj", MeshInvalid, "coincide"),
        (b"OFF\n3 1 0\n0 0 0\n", "a.off", MeshInvalid, "OFF"),
        (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0", "a.stl", MeshInvalid, "STL"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    data: bytes, name: str, error: type[InputError], says: str
) -> None:
    with pytest.raises(error, match=says) as caught:
        read_mesh(data, name)
    assert "\n" not in str(caught.value)


def test_counts_are_refused_before_they_are_read() -> None:
    ply = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 900000000\nproperty float x\n"
        b"property float y\nproperty float z\nelement face 1\n"
        b"property list uchar int vertex_indices\nend_header\n"
    )
    stl = b"\0" * 80 + struct.pack("<I", 20) + b"\0" * 1000
    off, obj = b"OFF\n900000000 1 0\n", SQUARE + b"f 1 2 3\n" * 20
    for data, name in ((ply, "a.ply"), (off, "a.off"), (obj, "a.obj"), (stl, "a.stl")):
        with pytest.raises(MeshInvalid, match="at most"):
            read_mesh(data, name, MeshLimits(max_faces=10))
    with pytest.raises(MeshInvalid, match="at most 3 vertices after welding, got 4"):
        read_mesh(SQUARE + b"f 1 2 3 4\n", "a.obj", MeshLimits(max_vertices=3))


def test_every_good_sample_is_read_and_comes_back(shared_inputs: Callable[[str], list[Path]]) -> None:
    for path in shared_inputs("good"):
        file = read_mesh(path.read_bytes(), path.name)
        offset = 0.01 * (file.mesh.vertices.amax(0) - file.mesh.vertices.amin(0)).max()
        moved = file.mesh.vertices + offset
        again = read_mesh(file.with_vertices(moved, torch.ones(len(moved))), "a.glb")
        tolerance = 1e-5 * float(moved.abs().max())
        torch.testing.assert_close(again.mesh.vertices, moved, rtol=0, atol=tolerance, msg=path.name)
        assert torch.equal(again.mesh.faces, file.mesh.faces), path.name
        assert len(read_mesh(file.confidence_glb(moved, torch.ones(len(moved))), "a.glb").mesh.faces)


def test_every_bad_sample_is_refused(shared_inputs: Callable[[str], list[Path]]) -> None:
    for path in shared_inputs("bad"):
        if path.name == "nancolor.obj":
            # One vertex has a NaN colour; its positions and faces are whole, and a user wants them refined.
            assert len(read_mesh(path.read_bytes(), path.name).mesh.faces) == 12
            continue
        if path.name == "points_emptyface.ply":  # 1,024 points
            assert "1024 points" in read_mesh(path.read_bytes(), path.name).warnings[0]
            continue
        with pytest.raises((MeshInvalid, FormatUnsupported)) as caught:
            read_mesh(path.read_bytes(), path.name)
        assert "\n" not in str(caught.value), path.name
