"""Coarse meshes whose long edges are split: what the new vertices are, and what stays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from refine_engine.files.mesh_file import MeshFile, read_mesh
from refine_engine.files.subdivide import LONGEST_EDGE, MOST_TRIANGLES
from refine_engine.values import Mesh


def edges_of(mesh: Mesh) -> tuple[torch.Tensor, torch.Tensor]:
    """Lengths, and how many faces have each."""
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(1).values
    edges, uses = sides.unique(dim=0, return_counts=True)
    return (mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]]).norm(dim=1), uses


def surface(mesh: Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2)


def read(data: bytes, name: str = "a.glb") -> tuple[MeshFile, MeshFile]:
    """As it is, and subdivided."""
    return read_mesh(data, name), read_mesh(data, name, subdivide=True)


def test_no_long_edge_is_left_and_the_surface_stays(textured: bytes) -> None:
    """A box with seams all along its edges is as closed as before."""
    coarse, fine = read(textured)
    longest = LONGEST_EDGE * float((coarse.mesh.vertices.amax(0) - coarse.mesh.vertices.amin(0)).max())
    lengths, uses = edges_of(fine.mesh)
    assert lengths.max() <= longest * 1.0001
    assert lengths.mean() > longest / 4
    assert (uses == edges_of(coarse.mesh)[1].unique()).all()
    assert surface(fine.mesh) == pytest.approx(surface(coarse.mesh), rel=1e-5)
    assert (fine.given_vertices, fine.given_faces) == (len(coarse.mesh.vertices), len(coarse.mesh.faces))
    assert fine.warnings[-1] == (
        f"the mesh was subdivided, from {len(coarse.mesh.vertices)} to {len(fine.mesh.vertices)} vertices"
    )


def test_attributes_are_interpolated(tools: Any) -> None:
    """Texture coordinates in bytes, colours and an attribute of one's own, each linear in x and y."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    glb = tools.Glb()
    attributes = {
        "POSITION": glb.add(corners),
        "TEXCOORD_0": glb.add(corners[:, :2] * 255, "u1", normalized=True),
        "COLOR_0": glb.add(corners * 0.5),
        "_HEAT": glb.add(10 * corners[:, :1]),
    }
    indices = glb.add([0, 1, 2, 1, 3, 2], "u2")
    glb.json["materials"] = [{"name": "paint"}]
    glb.json["meshes"] = [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}]
    fine = read_mesh(glb.build(), "a.glb", subdivide=True)
    written = fine.with_vertices(fine.mesh.vertices, torch.ones(len(fine.mesh.vertices)))
    head, _ = tools.split_glb(written)
    [primitive] = head["meshes"][0]["primitives"]
    value = {name: tools.values(written, at) for name, at in primitive["attributes"].items()}
    assert len(value["POSITION"]) == len(fine.mesh.vertices) > 200
    np.testing.assert_allclose(value["TEXCOORD_0"], value["POSITION"][:, :2], atol=1e-6)
    np.testing.assert_allclose(value["COLOR_0"][:, :2], value["POSITION"][:, :2] / 2, atol=1e-6)
    np.testing.assert_allclose(value["_HEAT"], 10 * value["POSITION"][:, :1], atol=1e-5)
    assert (primitive["material"], head["materials"][0]["name"]) == (0, "paint")


def test_a_mesh_without_long_edges_stays_as_it_is(textured: bytes) -> None:
    fine = read_mesh(textured, "a.glb", subdivide=True)
    ones = torch.ones(len(fine.mesh.vertices))
    again = read_mesh(fine.with_vertices(fine.mesh.vertices, ones), "a.glb", subdivide=True)
    assert not any("subdivided" in warning for warning in again.warnings)
    assert again.given_vertices == len(again.mesh.vertices) == len(fine.mesh.vertices)


def test_only_long_edges_are_split() -> None:
    """A small triangle beside a large one stays whole."""
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nv 2 0 0\nv 2.02 0 0\nv 2 0.02 0\nf 4 5 6\n"
    fine = read_mesh(text, "a.obj", subdivide=True).mesh
    small = (fine.vertices[fine.faces][..., 0] > 1.5).all(1)
    assert (int(small.sum()), len(fine.faces) > 100) == (1, True)


def test_instances_are_split_by_the_largest(tools: Any) -> None:
    """One triangle at two places, one of them ten times as large: both show the same mesh."""
    glb = tools.Glb()
    position = glb.add([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    glb.json["meshes"] = [{"primitives": [{"attributes": {"POSITION": position}}]}]
    glb.json["nodes"] = [{"mesh": 0, "scale": [10, 10, 10]}, {"mesh": 0, "translation": [0, 0, 5]}]
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    fine = read_mesh(glb.build(), "a.glb", subdivide=True).mesh
    assert edges_of(fine)[0].max() <= 10 * LONGEST_EDGE * 1.0001
    assert len(fine.faces) % 2 == 0


def test_a_surface_much_larger_than_its_box_ends_in_time() -> None:
    """A thousand crossing sheets would need more triangles than are made."""
    sheets = [
        f"v 0 {i} 0\nv 1000 {i} 0\nv 0 {i} 1000\nf {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(1000)
    ]
    fine = read_mesh("".join(sheets).encode(), "a.obj", subdivide=True).mesh
    assert 1000 < len(fine.faces) <= MOST_TRIANGLES
