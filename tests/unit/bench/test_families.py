"""Each family's meshes have the shape of that family: patches, voxels, a noisy field."""

import numpy as np
import pytest
import trimesh

from refine_bench import families
from refine_bench.families import FAMILIES, PATCH_SIDE, PATCHES, predict
from refine_bench.sets.families import family_cases
from refine_bench.shapes import make_shape
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.scores.scores import chamfer_l2, nearest_distances, sample_surface
from refine_engine.values import Mesh


@pytest.fixture(scope="module")
def predictions() -> dict[str, trimesh.Trimesh]:
    return {family: predict(family, make_shape("chair", 3), 1) for family in FAMILIES}


def pieces(mesh: trimesh.Trimesh) -> int:
    return int(mesh.body_count)


def test_predictions_resemble_the_object_and_are_named_by_the_seed(
    predictions: dict[str, trimesh.Trimesh],
) -> None:
    shape = make_shape("chair", 3)
    for family, mesh in predictions.items():
        clouds = [
            sample_surface(np.asarray(m.triangles), 4000, np.random.default_rng(k))
            for k, m in enumerate((mesh, shape))
        ]
        assert 0.2 < chamfer_l2(*nearest_distances(*clouds)) < 5.0  # of a longest side of 1
        assert len(mesh.faces) <= 3000
        assert np.array_equal(predict(family, shape, 1).vertices, mesh.vertices)
        assert not np.array_equal(predict(family, shape, 2).vertices, mesh.vertices)


def test_atlas_is_open_patches(predictions: dict[str, trimesh.Trimesh]) -> None:
    mesh = predictions["atlas"]
    assert pieces(mesh) == PATCHES
    assert len(mesh.vertices) == PATCHES * PATCH_SIDE**2
    assert not mesh.is_watertight


def test_the_field_is_closed_and_has_floaters(predictions: dict[str, trimesh.Trimesh]) -> None:
    mesh = predictions["field"]
    assert pieces(mesh) >= 3
    assert mesh.volume > 0.0  # outward


def test_cubify_makes_the_faces_between_filled_and_empty() -> None:
    filled = np.zeros((3, 2, 2), np.bool_)
    filled[0, 0, 0] = filled[1, 0, 0] = True
    vertices, faces = families.cubify(filled)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert (len(vertices), len(faces)) == (12, 20)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(2.0)
    assert mesh.bounds.tolist() == [[0, 0, 0], [2, 1, 1]]
    filled[1, 0, 0], filled[1, 1, 0] = False, True  # two cells that share an edge
    vertices, faces = families.cubify(filled)
    assert (len(vertices), len(faces)) == (14, 24)


def test_smoothing_draws_a_vertex_to_the_mean_of_its_neighbours() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    moved = families.smoothed(vertices, np.array([[0, 1, 2]]), 1)
    assert np.allclose(moved[0], [0.25, 0.25, 0.0])


def test_the_set_has_every_object_in_every_family() -> None:
    cases = family_cases()
    assert len(cases) == 60
    assert {case.level for case in cases} == set(FAMILIES)
    assert len({case.name for case in cases}) == 60
    scene = next(case for case in cases if case.level == "voxels" and case.category == "sofa").load()
    assert isinstance(scene.ground_truth, Mesh)
    assert silhouette_iou(scene.ground_truth, scene.view) == 1.0
    assert silhouette_iou(scene.coarse, scene.view) > 0.6
