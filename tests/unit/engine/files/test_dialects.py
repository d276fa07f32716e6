"""OBJ, PLY, STL and OFF as people's programs write them: shapes, colours, and what reading costs."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from refine_engine.errors import MeshInvalid
from refine_engine.files.mesh_file import MeshFile, read_mesh
from refine_engine.files.triangulate import triangulate

CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
VERTEX_LINES = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
FACE_LINES = "".join("f " + " ".join(str(i + 1) for i in quad) + "\n" for quad in QUADS)
L_SHAPE = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 5), (0, 5)]  # area 7; fans from most corners cover more


def area(file: MeshFile) -> float:
    a, b, c = (file.mesh.vertices[file.mesh.faces[:, k]] for k in range(3))
    return float((b - a).cross(c - a, dim=1).norm(dim=1).sum() / 2)


def written(file: MeshFile, tools: Any) -> dict[str, Any]:
    vertices = file.mesh.vertices
    head: dict[str, Any] = tools.split_glb(file.with_vertices(vertices, torch.ones(len(vertices))))[0]
    return head


def attributes(file: MeshFile, tools: Any) -> set[str]:
    return {name for p in written(file, tools)["meshes"][0]["primitives"] for name in p["attributes"]}


@pytest.mark.parametrize(
    "text",
    [
        VERTEX_LINES.replace(" ", "\t") + FACE_LINES.replace(" ", "\t"),
        (VERTEX_LINES + FACE_LINES).replace("f ", "  \tf ").replace("v ", "  v "),
        VERTEX_LINES + FACE_LINES.replace("\n", " # comment\n"),
        (VERTEX_LINES + FACE_LINES).replace("\n", "\r"),
        VERTEX_LINES + FACE_LINES.replace("f 1 2 ", "f 1 2 \\\n"),
        "\ufeff" + VERTEX_LINES + FACE_LINES,
        "\ufeff" + VERTEX_LINES + "v 9 9 9\n" + FACE_LINES,
    ],
)
def test_obj_dialects_are_read_alike(text: str) -> None:
    for data in (text.encode(), text.encode("utf-16") if text[0] != "\ufeff" else text.encode("utf-16-le")):
        file = read_mesh(data, "a.obj")
        assert (len(file.mesh.vertices), len(file.mesh.faces)) == (8, 12)
        assert area(file) == 6


def test_obj_counts_from_one() -> None:
    with pytest.raises(MeshInvalid, match="from 1, got 0"):
        read_mesh((VERTEX_LINES + "f 0 1 2\n").encode(), "a.obj")


@pytest.mark.parametrize("first", range(6))
def test_a_concave_polygon_covers_its_own_area(first: int) -> None:
    points = L_SHAPE[first:] + L_SHAPE[:first]
    rows = "".join(f"{x} {y} 0\n" for x, y in points)
    obj = "".join(f"v {row}\n" for row in rows.splitlines()) + "f 1 2 3 4 5 6\n"
    off = f"OFF\n6 1 0\n{rows}6 0 1 2 3 4 5\n"
    ply = (
        "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}6 0 1 2 3 4 5\n"
    )
    for text, name in ((obj, "a.obj"), (off, "a.off"), (ply, "a.ply")):
        assert area(read_mesh(text.encode(), name)) == pytest.approx(7)


@given(st.lists(st.floats(0.1, 1.0), min_size=4, max_size=40), st.integers(0, 99))
def test_a_star_is_cut_into_its_area_and_keeps_every_corner(radii: list[float], seed: int) -> None:
    angle = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    triangles, owner = triangulate(flat @ axes[:2], np.array([len(radii)]))
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    pieces = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    wanted = (flat[:, 0] * np.roll(flat[:, 1], -1) - flat[:, 1] * np.roll(flat[:, 0], -1)).sum() / 2
    assert np.abs(pieces).sum() == pytest.approx(wanted, rel=1e-6)
    assert set(triangles.ravel()) == set(range(len(radii)))
    assert not owner.any()


def test_polygons_of_many_corners_are_refused_unless_convex() -> None:
    angle = 2 * np.pi * np.arange(2000) / 2000
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    assert len(triangulate(circle, np.array([2000]))[0]) == 1998
    with pytest.raises(MeshInvalid, match="at most 500 corners"):
        triangulate(circle * np.where(np.arange(2000) % 2, 1, 0.5)[:, None], np.array([2000]))


XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(vertex: str, rows: str, face: str = "", tail: str = "4 {}") -> bytes:
    faces = "".join(tail.format(" ".join(map(str, quad))) + "\n" for quad in QUADS)
    return (
        f"ply\nformat ascii 1.0\nelement vertex 8\n{XYZ}{vertex}"
        f"element face 6\nproperty list uchar int vertex_indices\n{face}end_header\n"
        + "".join(f"{x} {y} {z}{rows}\n" for x, y, z in CORNERS)
        + faces
    ).encode()


RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


@pytest.mark.parametrize(
    ("data", "name", "kept"),
    [
        (ply(RGB.replace("y uchar ", "y uchar diffuse_"), " 1 2 3"), "a.ply", {"COLOR_0"}),
        (ply("", "", RGB, "4 {} 9 8 7"), "a.ply", {"COLOR_0"}),
        (ply("property float s\nproperty float t\n" + RGB, " 0 1 3 4 5"), "a.ply", {"COLOR_0", "TEXCOORD_0"}),
        (b"COFF\n3 1 0\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n0 1 0 0 1 0 1\n3 0 1 2\n", "a.off", {"COLOR_0"}),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n", "a.off", {"COLOR_0"}),
        (
            b"v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\n",
            "a.obj",
            {"COLOR_0", "TEXCOORD_0"},
        ),
    ],
)
def test_colours_and_texture_coordinates_are_kept(data: bytes, name: str, kept: set[str], tools: Any) -> None:
    file = read_mesh(data, name)
    assert kept <= attributes(file, tools)
    assert not file.warnings


def test_texture_coordinates_of_some_faces_are_kept_with_a_warning(tools: Any) -> None:
    text = VERTEX_LINES + "vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 2 4 3\n"
    file = read_mesh(text.encode(), "a.obj")
    assert "TEXCOORD_0" in attributes(file, tools)
    assert "3 of 6 corners have no texture coordinates" in file.warnings[0]


def test_what_is_written_looks_matte(tools: Any) -> None:
    material = written(read_mesh((VERTEX_LINES + FACE_LINES).encode(), "a.obj"), tools)["materials"][0]
    assert material["pbrMetallicRoughness"] == {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    assert material["doubleSided"]


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_with_polygons_of_several_sizes(order: str) -> None:
    name = {"<": "little", ">": "big"}[order]
    head = (
        f"ply\nformat binary_{name}_endian 1.0\nelement vertex 8\nproperty double x\nproperty double y\n"
        "property double z\nelement face 7\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = b"".join(struct.pack(order + "3d", *corner) for corner in CORNERS)
    body += b"".join(struct.pack(order + "B4i", 4, *quad) for quad in QUADS[:5])
    a, b, c, d = QUADS[5]
    body += struct.pack(order + "B3i", 3, a, b, c) + struct.pack(order + "B3i", 3, a, c, d)
    file = read_mesh(head.encode() + body, "a.ply")
    assert (len(file.mesh.faces), area(file)) == (12, 6)
    with pytest.raises(MeshInvalid, match="truncated PLY"):
        read_mesh(head.encode() + body[:-1], "a.ply")


def test_triangle_strips_of_ply() -> None:
    head = (
        "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
        "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    )
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
    file = read_mesh((head + rows + "9 0 1 2 3 -1 4 6 5 7\n").encode(), "a.ply")
    assert file.mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2], [4, 6, 5], [6, 7, 5]]


def lines_run(work: Callable[[], object]) -> int:
    """How many lines of Python the work runs: a cost that no load of the machine changes."""
    count = 0

    def trace(*_: Any) -> Any:
        nonlocal count
        count += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
SOLID = (
    b"solid a\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
)
OFF = b"OFF\n%s3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
HOSTILE: dict[str, Callable[[int], tuple[bytes, str]]] = {
    "empty lines in OBJ": lambda n: (b"\n" * n + TRIANGLE, "a.obj"),
    "empty lines in STL": lambda n: (b"\n" * n + SOLID, "a.stl"),
    "comments before the counts of OFF": lambda n: (OFF % (b"# \n" * n), "a.off"),
    "groups of OBJ": lambda n: (
        TRIANGLE + b"".join(b"g a%d\nusemtl m%d\nf 1 2 3\n" % (i, i) for i in range(n)),
        "a.obj",
    ),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_twice_the_input_costs_at_most_twice_the_lines(kind: str) -> None:
    small, large = (lines_run(partial(read_mesh, *HOSTILE[kind](n))) for n in (2000, 4000))
    assert large <= 2.2 * small


def test_what_backtracked_for_ever_is_read_at_once() -> None:
    """77 bytes took seconds, and twice that for every further line; the count of lines cannot see it."""
    assert len(read_mesh(OFF % (b"# \n" * 100_000), "a.off").mesh.faces) == 1
    assert len(read_mesh(b"\n" * 1_000_000 + TRIANGLE, "a.obj").mesh.faces) == 1
    assert len(read_mesh(b" \n" * 1_000_000 + SOLID, "a.stl").mesh.faces) == 1
