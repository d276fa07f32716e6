"""Points become a closed surface through them, whichever way their normals show."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refine_engine.errors import MeshInvalid
from refine_engine.files import gltf, points
from refine_engine.files.mesh_file import MeshFile, read_mesh


def ply(columns: dict[str, NDArray[Any]]) -> bytes:
    """A binary PLY file of points."""
    kinds = {"f": "float", "u": "uchar"}
    head = "".join(f"property {kinds[values.dtype.kind]} {name}\n" for name, values in columns.items())
    count = len(next(iter(columns.values())))
    rows = np.rec.fromarrays(
        [values.astype("<f4" if values.dtype.kind == "f" else "u1") for values in columns.values()]
    )
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{head}end_header\n".encode()
        + rows.tobytes()
    )


def cloud(points: NDArray[Any], normals: NDArray[Any] | None = None) -> bytes:
    columns = dict(zip("xyz", points.T, strict=True))
    if normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), normals.T, strict=True))
    return ply(columns)


def torus(count: int = 3000) -> tuple[Any, NDArray[Any], NDArray[Any]]:
    """A shape whose inside is not where its centre is: the mesh, points on it, their normals."""
    mesh: Any = trimesh.creation.torus(1.0, 0.35, 48, 24)
    places, faces = trimesh.sample.sample_surface(mesh, count, seed=1)
    return mesh, np.asarray(places), mesh.face_normals[faces]


def solid(file: MeshFile) -> Any:
    return trimesh.Trimesh(file.mesh.vertices.numpy(), file.mesh.faces.numpy(), process=False)


@pytest.mark.parametrize("normals", ["none", "outwards", "inwards"])
def test_the_surface_passes_through_the_points(normals: str) -> None:
    mesh, places, outwards = torus()
    given = {"none": None, "outwards": outwards, "inwards": -outwards}[normals]
    file = read_mesh(cloud(places + np.array([5, 0, 0]), given), "a.ply")
    made = solid(file)
    assert made.is_watertight
    assert (made.body_count, made.euler_number) == (1, 0)
    assert made.volume == pytest.approx(mesh.volume, rel=0.05)
    distance = cKDTree(made.vertices - [5, 0, 0]).query(places)[0]
    assert distance.mean() < 0.03
    told = "estimated from their neighbours" if given is None else "their own normals"
    assert told in file.warnings[0]
    assert "of 3000 points" in file.warnings[0]


def test_two_objects_are_both_right_side_out() -> None:
    _, places, _ = torus()
    made = solid(read_mesh(cloud(np.concatenate([places, places[::2] * 0.7 + [0, 0, 4]])), "a.ply"))
    assert sorted(body.volume > 0 for body in made.split()) == [True, True]


def test_points_keep_their_colours() -> None:
    _, places, _ = torus()
    red = np.where(places[:, 0] > 0, 255, 0).astype(np.uint8)
    zero = np.zeros_like(red)
    columns = dict(zip("xyz", places.T, strict=True)) | {"red": red, "green": zero, "blue": zero}
    file = read_mesh(ply(columns), "a.ply")
    document = gltf.parse(file.with_vertices(file.mesh.vertices, torch.ones(len(file.mesh.vertices))))
    attributes = document.json["meshes"][0]["primitives"][0]["attributes"]
    colours, positions = document.read(attributes["COLOR_0"]), document.read(attributes["POSITION"])
    far = np.abs(positions[:, 0]) > 0.1
    assert ((colours[far, 0] > 0.5) == (positions[far, 0] > 0)).all()


def test_a_share_of_very_many_points_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points, "_MOST", 1000)
    _, places, _ = torus()
    assert "from 1000 of 3000 points" in read_mesh(cloud(places), "a.ply").warnings[0]


def test_copies_and_clumps_of_points_cost_no_more_than_others() -> None:
    """Each clump is a piece of its own for the normals, and a tree cannot divide copies."""
    _, places, _ = torus(600)
    clumps = (places[:, None] + np.linspace(0, 1e-4, 20)[:, None]).reshape(-1, 3)
    copies = np.repeat(places, 100, axis=0)
    for cloud_of in (clumps, copies):
        assert len(read_mesh(cloud(cloud_of), "a.ply").mesh.faces)


@pytest.mark.parametrize(
    ("places", "says"),
    [
        (np.random.default_rng(0).random((20, 3)), "at least 50 points, got 20 points"),
        (np.full((100, 3), np.nan), "got 0 points"),
        (np.ones((100, 3)), "got 1 points"),
        (np.random.default_rng(0).random((100, 3)) * 1e35, "beyond 1e30"),
    ],
)
def test_refused(places: NDArray[Any], says: str) -> None:
    with pytest.raises(MeshInvalid, match=says):
        read_mesh(cloud(places), "a.ply")


def test_flat_points_and_lines_give_a_surface_or_a_word() -> None:
    chance = np.random.default_rng(0)
    for places in (chance.random((500, 3)) * [1, 1, 0], chance.random((500, 3)) * [1, 0, 0]):
        with suppress(MeshInvalid):
            assert len(read_mesh(cloud(places), "a.ply").mesh.faces)


def test_gaussian_splats_are_named() -> None:
    columns = {name: np.random.default_rng(0).random(100) for name in ("x", "y", "z", "f_dc_0")}
    with pytest.raises(MeshInvalid, match="got 100 Gaussian splats"):
        read_mesh(ply(columns), "a.ply")
