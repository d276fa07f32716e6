"""What comes back: the coarse mesh that agrees, or the last mesh that is not worse than it."""

from dataclasses import replace

import pytest
import torch

from refine_engine.cameras.seen import hard_silhouette
from refine_engine.method.config import RefineConfig, Stage
from refine_engine.method.loop import refine
from refine_engine.method.outcome import State, confidence_of, judge, keep
from refine_engine.method.whole_mesh import WholeMesh
from refine_engine.values import Camera, Mesh, Outcome, Progress, View

CAMERA = Camera.look_at(40, 20, 1.9, 50, 64, 64)
CONFIG = RefineConfig(stages=(Stage(3, 32, 1e-4),), encoder_size=32)


def scaled(mesh: Mesh, factor: float) -> Mesh:
    return Mesh(mesh.vertices * factor, mesh.faces)


def view_of(mesh: Mesh) -> View:
    return View(hard_silhouette(mesh, CAMERA).float(), CAMERA)


def state(outcome: Outcome, mesh: Mesh) -> State:
    everything = torch.ones(len(mesh.faces), dtype=torch.bool)
    return State(
        outcome, mesh, everything, None, torch.zeros(len(mesh.vertices)), loss_curve={"total": [1.0]}
    )


def moved(mesh: Mesh, truth: Mesh) -> WholeMesh:
    """The mesh moved as a whole, seen as `truth` is seen."""
    everything = torch.ones(len(mesh.faces), dtype=torch.bool)
    return WholeMesh(mesh, everything, (view_of(truth),), None, 0.0)


def test_a_mesh_that_agrees_is_kept_as_it_came(ball: Mesh) -> None:
    """Bit for bit, with its confidences, and with one report that says that all is done."""
    nearly = scaled(ball, 1.02)
    reports: list[Progress] = []
    result = refine(nearly, [view_of(ball)], CONFIG, reports.append)
    assert result.silhouette_iou_before >= 0.9
    assert result.outcome == "kept"
    assert torch.equal(result.mesh.vertices, nearly.vertices)
    assert torch.equal(result.mesh.faces, nearly.faces)
    assert result.kept_faces.all()
    assert not result.displacement.any()
    assert result.silhouette_iou_after == result.silhouette_iou_before
    assert (result.best_iteration, dict(result.loss_curve), result.warnings) == (0, {}, ())
    assert float(result.confidence.min()) > 0.9
    assert [(progress.iteration, progress.total) for progress in reports] == [(3, 3)]


@pytest.mark.parametrize("agreement", [None, 0.99])
def test_less_agreement_than_asked_for_is_refined(ball: Mesh, agreement: float | None) -> None:
    config = replace(CONFIG, agreement=agreement)
    result = refine(scaled(ball, 1.05), [view_of(ball)], config)
    assert result.outcome != "kept"
    assert result.displacement.any()


def test_a_result_that_is_not_worse_is_returned(ball: Mesh) -> None:
    refined = state("refined", ball)
    whole = moved(scaled(ball, 0.9), ball)
    assert judge(scaled(ball, 0.8), whole, refined, CONFIG, 0.64) is refined


def test_a_worse_result_gives_way_to_the_fitted_mesh(ball: Mesh) -> None:
    whole, refined = moved(scaled(ball, 0.9), ball), state("refined", scaled(ball, 0.5))
    judged = judge(scaled(ball, 0.8), whole, refined, CONFIG, 0.64)
    assert judged.outcome == "fitted"
    assert judged.mesh is whole.mesh
    assert judged.loss_curve == refined.loss_curve
    assert judged.warnings == (
        "the network's result agreed less with the silhouette than the coarse mesh did: "
        "the mesh was moved as a whole only",
    )


def test_when_both_are_worse_the_coarse_mesh_comes_back(ball: Mesh) -> None:
    coarse = scaled(ball, 0.8)
    whole, refined = moved(scaled(ball, 0.6), ball), state("refined", scaled(ball, 0.5))
    judged = judge(coarse, whole, refined, CONFIG, 0.64)
    assert judged.outcome == "kept"
    assert judged.mesh is coarse
    assert judged.loss_curve == refined.loss_curve
    (warning,) = judged.warnings
    assert warning.endswith("than the coarse mesh did: it is returned as it came")


def test_the_paper_returns_what_its_network_made(ball: Mesh) -> None:
    whole, refined = moved(ball, ball), state("refined", scaled(ball, 0.5))
    assert judge(scaled(ball, 0.8), whole, refined, RefineConfig.paper(), 0.64) is refined


def test_a_mesh_without_its_webs_is_judged_without_them(ball: Mesh) -> None:
    """Half of the faces are no longer there, unless the topology is fixed."""
    upper = Mesh(ball.vertices, ball.faces[ball.vertices[ball.faces].mean(1)[:, 1] > 0])
    there = ball.vertices[ball.faces].mean(1)[:, 1] > 0
    opened = replace(state("refined", ball), there=there)
    views = [view_of(upper)]
    assert opened.silhouette_iou(views, CONFIG) == 1.0
    assert opened.silhouette_iou(views, replace(CONFIG, topology="fixed")) < 0.8


def test_an_object_without_a_plane_has_no_confidence(ball: Mesh) -> None:
    assert not confidence_of(ball, None, CONFIG).any()
    kept = keep(ball, [view_of(ball)], replace(CONFIG, symmetry="none"), 1.0)
    assert kept.plane is None
    assert not kept.confidence.any()


def test_a_mesh_that_agrees_where_something_is_known_is_kept(ball: Mesh) -> None:
    view = view_of(ball)
    known = torch.ones(64, 64, dtype=torch.bool)
    known[:, 32:] = False
    hidden = View(view.silhouette * known, CAMERA, known)
    assert refine(ball, [hidden], CONFIG).outcome == "kept"
    assert refine(ball, [replace(hidden, known=None)], CONFIG).silhouette_iou_before < 0.6
