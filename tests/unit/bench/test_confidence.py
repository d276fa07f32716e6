"""Confidence of symmetry is judged by where the true object is symmetric."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refine_bench.cases import Case, Plane, Scene, mesh_of
from refine_bench.confidence import confidence_auc, mirror_distances
from refine_bench.outcome import Outcome
from refine_bench.runner import measures
from refine_bench.shapes import make_shape
from refine_engine.values import Camera, Mesh, MirrorPlane, View

PLANE = Plane((0.0, 0.0, 1.0), 0.0)
VIEW = View(torch.eye(32), Camera.look_at(30.0, 20.0, 1.6, 60.0, 32, 32))


def scene(category: str) -> Scene:
    truth = mesh_of(make_shape(category, 0).subdivide())
    return Scene(truth, VIEW, truth)


def case(category: str, asymmetric: bool) -> Case:
    return Case(category, category, lambda: scene(category), asymmetric=asymmetric, plane=PLANE)


def test_auc_by_hand() -> None:
    distances = np.array([0.0, 0.01, 0.2, 0.3])
    assert confidence_auc(np.array([0.9, 0.8, 0.1, 0.2]), distances) == 1.0
    assert confidence_auc(np.array([0.1, 0.2, 0.9, 0.8]), distances) == 0.0
    assert confidence_auc(np.array([0.5, 0.5, 0.5, 0.5]), distances) == 0.5
    assert confidence_auc(np.array([0.9, 0.3, 0.1, 0.5]), distances) == 0.75  # one of four pairs is wrong
    assert confidence_auc(np.ones(4), np.zeros(4)) is None


def test_the_one_armrest_is_what_is_asymmetric() -> None:
    truth = scene("one_armed_chair").ground_truth
    assert isinstance(truth, Mesh)
    distances = mirror_distances(truth.vertices.double().numpy(), truth, (0.0, 0.0, 1.0), 0.0)
    asymmetric = truth.vertices[torch.from_numpy(distances > 0.05)]
    assert 50 < len(asymmetric) < 0.4 * len(distances)
    assert float(asymmetric[:, 2].min()) > 0.1  # the arm is at +z
    turned = moved(Mesh(truth.vertices[:, [2, 1, 0]], truth.faces), 0.3)
    again = mirror_distances(turned.vertices.double().numpy(), turned, (2.0, 0.0, 0.0), 0.6)
    assert np.allclose(again, distances, atol=0.02)


MADE = MirrorPlane(torch.tensor([0.0, 0.0, 1.0]), 0.0, None)


def moved(mesh: Mesh, x: float) -> Mesh:
    return Mesh(mesh.vertices + torch.tensor([x, 0.0, 0.0]), mesh.faces)


def test_measures_are_mean_or_auc_and_how_far_the_vertices_moved() -> None:
    table, chair = scene("table"), scene("one_armed_chair")
    half = torch.full((len(table.coarse.vertices),), 0.5)
    found = measures(case("table", False), table, Outcome(moved(table.coarse, 0.02), 1.0, half))
    assert found["confidence_mean"] == pytest.approx(0.5)
    assert found["confidence_auc"] is None
    side = float((table.coarse.vertices.amax(0) - table.coarse.vertices.amin(0)).max())
    assert found["motion"] == pytest.approx(2.0 / side, rel=1e-3)
    arm = (chair.coarse.vertices[:, 2] > 0.1) & (chair.coarse.vertices[:, 1] > 0.05)
    asked = measures(
        case("one_armed_chair", True), chair, Outcome(chair.coarse, 1.0, 1.0 - 0.9 * arm.float(), MADE)
    )
    assert asked["confidence_mean"] is None
    assert asked["confidence_auc"] is not None
    assert asked["confidence_auc"] > 0.8
    unknown = replace(case("table", False), plane=Plane((0.0, 0.0, 1.0)))
    assert measures(unknown, table, Outcome(table.coarse, 1.0, half))["confidence_mean"] is None
    fewer = Mesh(table.coarse.vertices[:-1], table.coarse.faces[(table.coarse.faces < len(half) - 1).all(1)])
    assert measures(case("table", False), table, Outcome(fewer, 1.0))["motion"] is None
