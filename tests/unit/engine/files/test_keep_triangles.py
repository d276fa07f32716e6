"""Files that lose triangles: the indices change and nothing else."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from refine_engine.files.mesh_file import MeshFile, read_mesh

Triangles = set[tuple[tuple[float, ...], ...]]


def write(file: MeshFile, kept: NDArray[np.bool_] | None) -> bytes:
    """The file with its vertices where they were."""
    vertices = file.mesh.vertices
    return file.with_vertices(
        vertices, torch.ones(len(vertices)), None if kept is None else torch.from_numpy(kept)
    )


def triangles(file: MeshFile, kept: NDArray[np.bool_] | None = None) -> Triangles:
    """Of the welded mesh, as corners in world units from the least one on: the winding counts."""
    corners = file.mesh.vertices[file.mesh.faces].numpy().round(4) + 0.0
    rows = [[tuple(corner) for corner in row] for row in corners.tolist()]
    chosen = range(len(rows)) if kept is None else np.flatnonzero(kept)
    turned = []
    for i in chosen:
        first = rows[i].index(min(rows[i]))
        turned.append(tuple(rows[i][first:] + rows[i][:first]))
    return set(turned)


def but(count: int, *removed: int) -> NDArray[np.bool_]:
    kept = np.ones(count, dtype=bool)
    kept[list(removed)] = False
    return kept


def test_only_the_indices_change(tools: Any, textured: bytes) -> None:
    """A textured cube: its vertices with their texture coordinates, its image and its nodes stay."""
    file = read_mesh(textured, "a.glb")
    kept = but(12, 0, 3, 7)
    (before, binary), (after, longer) = (tools.split_glb(write(file, k)) for k in (None, kept))
    assert longer[: len(binary)] == binary
    assert after["accessors"][: len(before["accessors"])] == before["accessors"]
    one, other = (head["meshes"][0]["primitives"][0] for head in (before, after))
    assert other["attributes"] == one["attributes"]
    assert "TEXCOORD_0" in other["attributes"]
    assert after["accessors"][other["indices"]]["count"] == 27
    for name in ("nodes", "images", "textures", "materials", "animations", "extras"):
        assert after[name] == before[name]
    assert triangles(read_mesh(write(file, kept), "a.glb")) == triangles(file, kept)


def test_all_kept_is_the_same_file(textured: bytes) -> None:
    file = read_mesh(textured, "a.glb")
    assert write(file, but(12)) == write(file, None)


@pytest.mark.parametrize("scale", [[-1, 1, 1], [1, -2, 1], [-1, -1, -1]])
def test_a_mirrored_node(tools: Any, scale: list[float]) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0, "scale": scale, "translation": [1, 2, 3]}]
    file = read_mesh(glb.build(), "a.glb")
    kept = but(12, 1, 2, 11)
    assert triangles(read_mesh(write(file, kept), "a.glb")) == triangles(file, kept)


def test_two_instances_lose_their_own(tools: Any) -> None:
    """One mesh that two nodes place: the first loses two triangles, the second one other."""
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    file = read_mesh(glb.build(), "a.glb")
    kept = but(24, 0, 4, 12 + 9)
    data = write(file, kept)
    assert triangles(read_mesh(data, "a.glb")) == triangles(file, kept)
    head, _ = tools.split_glb(data)
    counts = [
        head["accessors"][head["meshes"][node["mesh"]]["primitives"][0]["indices"]]["count"]
        for node in head["nodes"]
    ]
    assert counts == [30, 33]


def test_a_primitive_that_would_lose_all_keeps_them(tools: Any) -> None:
    """Two primitives: the second is two triangles, all to be removed; of the first one goes."""
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    lid = tools.cube[:4] + np.array([3.0, 0.0, 0.0], np.float32)
    second = {"attributes": {"POSITION": glb.add(lid)}, "indices": glb.add([0, 1, 3, 0, 3, 2], "u2")}
    glb.json["meshes"][0]["primitives"].append(second)
    file = read_mesh(glb.build(), "a.glb")
    data = write(file, but(14, 5, 12, 13))
    assert triangles(read_mesh(data, "a.glb")) == triangles(file, but(14, 5))
    _, unchanged = tools.split_glb(data)[0]["meshes"][0]["primitives"]
    assert unchanged["indices"] == second["indices"]


def test_a_mesh_without_indices_gets_some(tools: Any) -> None:
    """Every three vertices are a triangle; those that are left are listed."""
    glb = tools.Glb()
    glb.mesh(tools.cube[tools.cube_faces.ravel()])
    file = read_mesh(glb.build(), "a.glb")
    kept = but(12, 6)
    assert triangles(read_mesh(write(file, kept), "a.glb")) == triangles(file, kept)
