"""Tangents of a GLB follow its surface."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from refine_engine.errors import MeshInvalid
from refine_engine.files import gltf
from refine_engine.files.mesh_file import MeshFile, read_mesh
from refine_engine.files.tangents import carried_tangents


def attribute(data: bytes, name: str) -> Any:
    document = gltf.parse(data)
    return document.read(document.json["meshes"][0]["primitives"][0]["attributes"][name])


def sphere(tools: Any) -> bytes:
    """A grid on a sphere whose tangents go along its circles of latitude, every second one left-handed."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(-1.2, 1.2, 12))
    points = np.stack([np.cos(v) * np.cos(u), np.sin(v), np.cos(v) * np.sin(u)], -1).reshape(-1, 3)
    along = np.stack([-np.sin(u), 0 * u, np.cos(u), np.where(np.arange(25) % 2, -1, 1) + 0 * u], -1)
    corner = (np.arange(11)[:, None] * 25 + np.arange(24)).ravel()
    quads = np.stack([corner, corner + 25, corner + 26, corner + 1], 1)
    glb = tools.Glb()
    primitive = glb.mesh(points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
    primitive["attributes"] |= {"NORMAL": glb.add(points), "TANGENT": glb.add(along.reshape(-1, 4))}
    built: bytes = glb.build()
    return built


def written(file: MeshFile, vertices: torch.Tensor) -> bytes:
    return file.with_vertices(vertices, torch.ones(len(vertices)))


def test_they_turn_with_the_object(tools: Any) -> None:
    data = sphere(tools)
    file, turn = read_mesh(data, "a.glb"), Rotation.from_euler("xyz", [0.4, 1.1, -0.3])
    refined = written(file, torch.from_numpy(turn.apply(file.mesh.vertices.numpy())).float())
    before, after = attribute(data, "TANGENT"), attribute(refined, "TANGENT")
    expected = turn.apply(before[:, :3])
    assert np.degrees(np.arccos((after[:, :3] * expected).sum(1).clip(-1, 1))).max() < 3
    assert (after[:, 3] == before[:, 3]).all()


def test_they_stay_units_across_the_normals_of_a_bent_surface(tools: Any) -> None:
    file = read_mesh(sphere(tools), "a.glb")
    x, y, z = file.mesh.vertices.T
    refined = written(file, torch.stack([x + 0.4 * y * y, y + 0.3 * torch.sin(3 * x), 0.5 * z], 1))
    tangents, normals = attribute(refined, "TANGENT")[:, :3], attribute(refined, "NORMAL")
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose((tangents * normals).sum(1), 0, atol=1e-5)


def test_a_stretched_sheet_stretches_them() -> None:
    """What the sheet shows along (1, 1) it shows along (2, 1) when it is twice as wide."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces, up = np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0, 1], (4, 1))
    diagonal = np.tile([0.5**0.5, 0.5**0.5, 0, -1], (4, 1))
    moved = carried_tangents(diagonal, square, square * [2, 1, 1], faces, up)
    np.testing.assert_allclose(moved, np.tile([2 / 5**0.5, 1 / 5**0.5, 0, -1], (4, 1)), atol=1e-12)


def test_flat_triangles_and_broken_tangents_give_some_unit_tangent() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]])
    broken = np.array([[np.nan, 0, 0, 1], [0, 0, 0, 0], [0, 0, 1, 1], [7, 7, 7, 7]])
    moved = carried_tangents(broken, line, line, np.array([[0, 1, 2]]), np.tile([0.0, 0, 1], (4, 1)))
    np.testing.assert_allclose(np.linalg.norm(moved[:3, :3], axis=1), 1)
    assert moved[3].tolist() == [7, 7, 7, 7]  # no triangle uses it


def test_what_no_tangents_are_is_refused_before_the_run(tools: Any) -> None:
    glb = tools.Glb()
    primitive = glb.mesh(tools.split, tools.split_faces)
    primitive["attributes"] |= {"NORMAL": glb.add(tools.normals), "TANGENT": glb.add(tools.normals)}
    with pytest.raises(MeshInvalid, match="4 components in TANGENT"):
        read_mesh(glb.build(), "a.glb")
