from __future__ import annotations

from typing import Any

import numpy as np

from refine_engine.files.weld import weld


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


def test_copies_that_differ_by_rounding_are_joined(tools: Any) -> None:
    noise = np.random.default_rng(0).uniform(-3e-6, 3e-6, tools.split.shape)
    assert len(weld(tools.split + noise, tools.split_faces).source_of) == 8


def test_a_far_triangle_does_not_melt_a_small_object(tools: Any) -> None:
    far = np.array([[1e6, 0, 0], [1e6, 1, 0], [1e6, 0, 1]])
    points = np.concatenate([tools.split.astype(np.float64), far])
    faces = np.concatenate([tools.split_faces, [[24, 25, 26]]])
    assert len(weld(points, faces).source_of) == 11


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
