"""SyntheticShift is the same set every time, and its levels are what they are called."""

import collections

import numpy as np
import pytest
import torch

from refine_bench.cases import Scene
from refine_bench.sets.synthetic import CATEGORIES, LEVELS, synthetic_cases
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.scores.scores import chamfer_l2, nearest_distances, sample_surface
from refine_engine.values import Mesh


def error(scene: Scene) -> float:
    """Chamfer-l2 of the coarse mesh, in units of the truth's box."""
    assert isinstance(scene.ground_truth, Mesh)
    clouds = [
        sample_surface(mesh.vertices.double()[mesh.faces].numpy(), 3000, np.random.default_rng(seed))
        for seed, mesh in enumerate((scene.coarse, scene.ground_truth))
    ]
    return chamfer_l2(*nearest_distances(*clouds))


def test_sixty_cases_of_ten_categories_at_three_levels() -> None:
    cases = synthetic_cases()
    assert len(cases) == len({case.name for case in cases}) == 60
    assert collections.Counter(case.level for case in cases) == dict.fromkeys(LEVELS, 20)
    assert collections.Counter(case.category for case in cases) == dict.fromkeys(CATEGORIES, 6)
    assert sum(case.asymmetric for case in cases) == 15


def test_the_small_subset_is_part_of_the_full_set() -> None:
    small = synthetic_cases("small")
    assert {case.name for case in small} < {case.name for case in synthetic_cases()}
    assert collections.Counter(case.level for case in small) == dict.fromkeys(LEVELS, 4)
    assert {case.category for case in small} == set(CATEGORIES)
    assert sum(case.asymmetric for case in small) == 2


def test_the_same_case_is_made_twice() -> None:
    case = synthetic_cases()[5]
    first, second = case.load(), case.load()
    assert torch.equal(first.coarse.vertices, second.coarse.vertices)
    assert torch.equal(first.view.silhouette, second.view.silhouette)
    assert torch.equal(first.view.camera.world_to_camera, second.view.camera.world_to_camera)


@pytest.mark.parametrize("category", ["cabinet", "display"])
def test_levels_share_the_object_and_get_worse(category: str) -> None:
    scenes = {
        case.level: case.load()
        for case in synthetic_cases()
        if case.category == category and "_0_" in case.name
    }
    mild, strong, out_of_class = (scenes[level] for level in LEVELS)
    assert isinstance(mild.ground_truth, Mesh)
    assert isinstance(strong.ground_truth, Mesh)
    assert torch.equal(mild.ground_truth.vertices, strong.ground_truth.vertices)
    assert torch.equal(mild.view.silhouette, out_of_class.view.silhouette)
    assert error(mild) < error(strong)
    assert error(mild) < error(out_of_class)
    assert silhouette_iou(mild.ground_truth, mild.view) == 1.0
    for scene in scenes.values():
        assert 1300 <= len(scene.coarse.vertices) <= 1600
        assert in_image(scene.coarse, scene)


def in_image(mesh: Mesh, scene: Scene) -> bool:
    camera = scene.view.camera
    points = mesh.vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    x, y = (points[:, :2] / points[:, 2:] * camera.fx + camera.cx).T
    return bool((points[:, 2] > 0).all() and min(x.min(), y.min()) > 0 and max(x.max(), y.max()) < 224)
