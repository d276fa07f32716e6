from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from refine_engine.files.weld import Floats, Ints, smooth_groups, vertex_normals, weld


def two(vertices: Any, faces: Any, shift: Any) -> tuple[Any, Any]:
    points = np.concatenate([vertices, vertices + np.asarray(shift)]).astype(np.float64)
    return points, np.concatenate([faces, faces + len(vertices)])


def test_copies_at_a_seam_become_one_in_file_order(tools: Any) -> None:
    joined = weld(tools.split.astype(np.float64), tools.split_faces)
    assert len(joined.source_of) == 8
    assert np.array_equal(joined.source_of, np.sort(joined.source_of))
    assert np.array_equal(tools.split[joined.source_of][joined.vertex_of], tools.split)


def test_closed_objects_that_touch_stay_apart(tools: Any) -> None:
    points, faces = two(tools.cube, tools.cube_faces, [1, 1, 1])  # they share one corner
    assert len(weld(points, faces).source_of) == 16


def test_a_fin_on_a_wall_stays_attached(tools: Any) -> None:
    fin = np.array([[0, 0, 0], [0, 0, 1], [-1, 0, 0]], np.float64)  # along an edge of the cube
    points = np.concatenate([tools.cube.astype(np.float64), fin])
    faces = np.concatenate([tools.cube_faces, [[8, 9, 10]]])
    assert len(weld(points, faces).source_of) == 9


def test_two_close_shells_stay_apart(tools: Any) -> None:
    points, faces = two(tools.cube, tools.cube_faces, [1e-6, 0, 0])
    assert len(weld(points, faces).source_of) == 16


@pytest.mark.parametrize("centre", [0.0, 0.5, -3.0])
@pytest.mark.parametrize("size", [0.001, 1.0, 1000.0])
def test_copies_that_differ_by_rounding_are_joined(tools: Any, size: float, centre: float) -> None:
    noise = np.random.default_rng(0).uniform(-3e-6, 3e-6, tools.split.shape)
    assert len(weld(size * (tools.split + noise - centre), tools.split_faces).source_of) == 8


def test_places_are_numbers_not_bits() -> None:
    two_zeros = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [1, -0.0, 0], [0, 0, 1]])
    assert len(weld(two_zeros, np.array([[0, 1, 2], [3, 4, 5]])).source_of) == 4


def test_a_border_triangle_smaller_than_the_tolerance_is_not_swallowed() -> None:
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    points = np.array([*square, [1 + 2e-6, 0, 0], [1, -2e-6, 0]], np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5]])
    assert np.array_equal(weld(points, faces).faces, faces)


@pytest.mark.parametrize("x", [0.0, 2000.0])
def test_a_far_triangle_does_not_melt_a_small_object(tools: Any, x: float) -> None:
    far = np.array([[1e6, 0, 0], [1e6, 1, 0], [1e6, 0, 1]])
    points = np.concatenate([tools.split + np.array([x, 0.0, 0.0]), far])
    faces = np.concatenate([tools.split_faces, [[24, 25, 26]]])
    assert len(weld(points, faces).source_of) == 11


@pytest.mark.parametrize(("gap", "vertices"), [(0.05, 6), (0.3, 9)])
def test_borders_nearer_than_a_tenth_of_an_edge_are_joined(gap: float, vertices: int) -> None:
    """Edges of length 1, and a triangle so far away that the tolerance alone would join what is 0.5 apart."""
    triangle = np.array([[2000.0, 0, 0], [2001, 0, 0], [2000, 1, 0]])
    near, far = np.array([0, 0, gap]), np.array([50_000, 0, 0])
    points = np.concatenate([triangle, triangle + near, triangle + far])
    assert len(weld(points, np.arange(9).reshape(3, 3)).source_of) == vertices


def test_a_sheet_stored_once_per_side_is_one_sheet(tools: Any) -> None:
    points, faces = two(tools.cube, tools.cube_faces, [0, 0, 0])
    faces[len(faces) // 2 :] = faces[len(faces) // 2 :, ::-1]
    assert len(weld(points, faces).source_of) == 8


def test_doubled_triangles_do_not_hide_a_seam(tools: Any) -> None:
    faces = np.concatenate([tools.split_faces, tools.split_faces[:, ::-1]])
    assert len(weld(tools.split.astype(np.float64), faces).source_of) == 8


def test_triangles_without_an_area_of_their_own_go(tools: Any) -> None:
    points = np.concatenate([tools.cube, tools.cube[:1]]).astype(np.float64)
    faces = np.concatenate([tools.cube_faces, [[0, 0, 1], [0, 8, 1]]])
    joined = weld(points, faces)
    assert np.array_equal(joined.faces, tools.cube_faces)
    assert joined.vertex_of[8] == 0


def test_copies_of_a_vertex_share_a_normal_unless_an_edge_is_hard() -> None:
    up, nearly_up, side = [0.0, 1.0, 0.0], [0.05, 0.99875, 0.0], [1.0, 0.0, 0.0]
    copies = [(0, up), (1, up), (0, nearly_up), (0, side), (1, nearly_up), (2, up), (-1, up), (-1, up)]
    vertex_of, normals = (np.array(column) for column in zip(*copies, strict=True))
    group = smooth_groups(vertex_of, normals)
    assert groups(group, np.arange(8)) == {
        frozenset(names) for names in ({0, 2}, {1, 4}, {3}, {5}, {6}, {7})
    }  # which vertex of the file is in which


@pytest.mark.parametrize("size", [0.01, 1.0, 100.0])
def test_a_normal_is_the_mean_by_area_whichever_way_the_triangles_are_wound(size: float) -> None:
    """Triangle 0-1-2 lies on the ground and faces up; 0-3-1 stands and faces -Z, its normals +Z."""
    points = size * np.array([[3.0, 5, -2], [4, 5, -2], [3, 5, -3], [3, 6, -2], [0, 0, 0]])
    faces, half = np.array([[0, 1, 2], [0, 3, 1]]), np.sqrt(0.5)
    shown = np.tile([0.0, half, half], (5, 1))
    normals = vertex_normals(points, points, faces, np.arange(5), shown)
    mean, ground, wall = [0, half, half], [0, 1, 0], [0, 0, 1]
    np.testing.assert_allclose(normals, [mean, mean, ground, wall, shown[4]], atol=1e-12)


@st.composite
def soups(draw: st.DrawFn) -> tuple[Floats, Ints]:
    """Up to ten triangles on up to 27 places, some vertices off their place by rounding. Every awkward case
    is among them: flat triangles, doubled ones, fans that touch, vertices that no triangle uses."""
    count = draw(st.integers(3, 12))
    places = draw(arrays(np.float64, (count, 3), elements=st.integers(0, 2).map(float)))
    rounding = draw(arrays(np.float64, (count, 3), elements=st.sampled_from([0.0, 0.0, 1e-6, -2e-6])))
    faces = draw(arrays(np.int64, (draw(st.integers(1, 10)), 3), elements=st.integers(0, count - 1)))
    return places + rounding, faces


@given(soups())
def test_what_every_weld_keeps(soup: tuple[Floats, Ints]) -> None:
    positions, faces = soup
    joined = weld(positions, faces)
    count = len(joined.source_of)
    assert (np.diff(joined.source_of) > 0).all()
    assert np.array_equal(joined.vertex_of[joined.source_of], np.arange(count))
    assert set(joined.faces.ravel().tolist()) == set(range(count))
    assert all(len(set(face)) == 3 for face in joined.faces.tolist())
    used = joined.vertex_of >= 0
    assert np.abs(positions[joined.source_of][joined.vertex_of[used]] - positions[used]).max(initial=0) < 1e-5
    kept = [face for face in joined.vertex_of[faces].tolist() if -1 not in face and len(set(face)) == 3]
    assert kept == joined.faces.tolist()


@given(soups(), st.randoms(use_true_random=False))
def test_the_order_in_the_file_does_not_matter(soup: tuple[Floats, Ints], random: Any) -> None:
    positions, faces = soup
    old_of_new = np.array(random.sample(range(len(positions)), len(positions)))
    order = random.sample(range(len(faces)), len(faces))
    shuffled = weld(positions[old_of_new], np.argsort(old_of_new)[faces[order]])
    assert groups(shuffled.vertex_of, old_of_new) == groups(
        weld(positions, faces).vertex_of, np.arange(len(positions))
    )


def groups(vertex_of: Ints, name_of: Ints) -> set[frozenset[int]]:
    """Which vertices of the file became one."""
    members = defaultdict(set)
    for vertex, name in zip(vertex_of.tolist(), name_of.tolist(), strict=True):
        members[vertex].add(name)
    return {frozenset(names) for vertex, names in members.items() if vertex >= 0}


@given(soups(), st.integers(-30, 30))
def test_nothing_is_left_to_join_and_units_do_not_matter(soup: tuple[Floats, Ints], exponent: int) -> None:
    positions, faces = soup
    joined = weld(positions, faces)
    again = weld(positions[joined.source_of] * 2.0**exponent, joined.faces)
    assert np.array_equal(again.faces, joined.faces)


@given(soups())
def test_triangles_with_corners_of_their_own_are_joined_by_place(soup: tuple[Floats, Ints]) -> None:
    """STL and flat-shaded files: every corner is on an open border."""
    corners = np.round(soup[0])[soup[1]]  # (F, 3, 3)
    joined = weld(corners.reshape(-1, 3), np.arange(corners.shape[0] * 3).reshape(-1, 3))
    proper = [triangle for triangle in corners.tolist() if len(set(map(tuple, triangle))) == 3]
    assert len(joined.faces) == len(proper)
    assert len(joined.source_of) == len({tuple(place) for triangle in proper for place in triangle})
