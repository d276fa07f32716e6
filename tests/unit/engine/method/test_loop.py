"""Whole runs, short and small: a dozen iterations at 48 pixels."""

import io
import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from refine_engine.cameras.seen import hard_silhouette, mean_silhouette_iou
from refine_engine.errors import Cancelled, Diverged
from refine_engine.method.config import ProportionFit, RefineConfig, Stage
from refine_engine.method.loop import TERMS, Snapshot, refine
from refine_engine.values import Camera, Mesh, Progress, Result, View

SHORT = RefineConfig(
    proportions=ProportionFit(iterations=5, render_size=32),
    stages=(Stage(4, 32, 1e-3), Stage(8, 48, 3e-4)),
    encoder_size=32,
    learning_rate=2e-4,
    symmetry_azimuths_degrees=(45.0,),
    symmetry="plane",
    agreement=None,
)
SETTLED = replace(SHORT, proportions=ProportionFit(iterations=40, render_size=64))
# Adam turns the rounding of a gradient into steps: small ones, for runs that are compared but not bit by bit.
GENTLE = replace(SHORT, proportions=None, learning_rate=3e-5)
CAMERA = Camera.look_at(40, 20, 1.9, 50, 64, 64)


def view_of(mesh: Mesh, camera: Camera = CAMERA) -> View:
    return View(hard_silhouette(mesh, camera).float(), camera)


def stretched(mesh: Mesh, *scale: float) -> Mesh:
    return Mesh(mesh.vertices * torch.tensor(scale), mesh.faces)


@pytest.fixture
def views(ball: Mesh) -> list[View]:
    """What a flat and long ball looks like."""
    return [view_of(stretched(ball, 1.2, 0.8, 1.0))]


def same(one: Result, other: Result) -> bool:
    return torch.equal(one.mesh.vertices, other.mesh.vertices) and one.loss_curve == other.loss_curve


def offset_of(result: Result) -> float:
    assert result.plane is not None
    return result.plane.offset


def check(result: Result, mesh: Mesh, config: RefineConfig = SHORT) -> None:
    """What holds for every result."""
    assert torch.equal(result.mesh.faces, mesh.faces[result.kept_faces])
    assert result.mesh.vertices.shape == mesh.vertices.shape
    assert torch.isfinite(result.mesh.vertices).all()
    torch.testing.assert_close(result.displacement, result.mesh.vertices - mesh.vertices)
    assert result.confidence.shape == mesh.vertices[:, 0].shape
    low, high = result.confidence.aminmax()
    assert 0 <= float(low) <= float(high) <= 1
    assert set(result.loss_curve) == {*TERMS, "total"}
    assert all(len(curve) == config.iterations for curve in result.loss_curve.values())
    assert all(math.isfinite(value) for curve in result.loss_curve.values() for value in curve)


def test_the_seed_decides_the_result(ball: Mesh, views: list[View]) -> None:
    one, again = refine(ball, views, SHORT), refine(ball, views, SHORT)
    check(one, ball)
    assert same(one, again)
    assert not same(one, refine(ball, views, replace(SHORT, seed=1)))


def test_it_does_not_touch_what_it_is_given_nor_torchs_random_numbers(ball: Mesh, views: list[View]) -> None:
    vertices, faces, silhouette = ball.vertices.clone(), ball.faces.clone(), views[0].silhouette.clone()
    state = torch.get_rng_state()
    refine(ball, views, SHORT)
    assert torch.equal(ball.vertices, vertices)
    assert torch.equal(ball.faces, faces)
    assert torch.equal(views[0].silhouette, silhouette)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("learning_rate", [2e-4, 0.01])
def test_the_result_is_the_best_iterate_of_the_last_stage(
    ball: Mesh, views: list[View], learning_rate: float
) -> None:
    """At the larger rate the loss jumps about, and the last iterate is not the best."""
    config = replace(SHORT, proportions=None, learning_rate=learning_rate)
    result = refine(ball, views, config)
    last_stage = list(result.loss_curve["total"])[4:]
    assert result.best_iteration == 5 + last_stage.index(min(last_stage))
    if learning_rate == 0.01:
        assert result.best_iteration < config.iterations
    # one iteration fewer than the best would be another mesh, all up to it are the same
    until = replace(config, stages=(config.stages[0], Stage(result.best_iteration - 4, 48, 3e-4)))
    assert torch.equal(refine(ball, views, until).mesh.vertices, result.mesh.vertices)


def test_the_first_iterate_is_the_mesh_that_came_in(ball: Mesh, views: list[View]) -> None:
    config = replace(SHORT, proportions=None, stages=(Stage(1, 48, 3e-4),))
    result = refine(ball, views, config)
    torch.testing.assert_close(result.mesh.vertices, ball.vertices, atol=1e-6, rtol=0)
    assert result.best_iteration == 1
    assert result.loss_curve["displacement"] == [0.0]


def test_total_is_the_sum_of_the_weighted_terms(ball: Mesh, views: list[View]) -> None:
    curve = refine(ball, views, SHORT).loss_curve
    for i, total in enumerate(curve["total"]):
        assert sum(curve[term][i] for term in TERMS) == pytest.approx(total, rel=1e-5)


def test_reports_go_forward_and_end_with_the_last_iteration(ball: Mesh, views: list[View]) -> None:
    reports: list[Progress] = []
    result = refine(ball, views, SHORT, report=reports.append)
    iterations = [progress.iteration for progress in reports]
    assert iterations[-1] == 12
    assert iterations[0] == 0  # while the mesh is fitted as a whole
    assert iterations == sorted(iterations)
    for progress in reports:
        assert progress.total == 12
        assert 0 <= progress.silhouette_iou <= 1
        if not progress.iteration:
            assert not progress.losses
            continue
        now = {name: curve[progress.iteration - 1] for name, curve in result.loss_curve.items()}
        assert dict(progress.losses) == now


@pytest.mark.parametrize(("asked_before", "after"), [(0, 0), (3, 0), (5, 0), (6, 1), (12, 7)])
def test_cancelled_between_iterations(ball: Mesh, views: list[View], asked_before: int, after: int) -> None:
    """The first five are those of the fit of the whole mesh, of which none of the twelve is."""
    asked = iter(range(100))
    with pytest.raises(Cancelled, match=f"cancelled after {after} of 12 iterations"):
        refine(ball, views, SHORT, cancelled=lambda: next(asked) >= asked_before)


def test_not_cancelled_is_the_same_run(ball: Mesh, views: list[View]) -> None:
    assert same(refine(ball, views, SHORT, cancelled=lambda: False), refine(ball, views, SHORT))


@pytest.mark.parametrize("reported", [False, True])
def test_steps_without_bound_diverge(ball: Mesh, views: list[View], reported: bool) -> None:
    config = replace(SHORT, learning_rate=1e30)
    with pytest.raises(Diverged, match=r"the loss became (nan|inf) by iteration \d+; try another seed"):
        refine(ball, views, config, report=(lambda _: None) if reported else None)


def test_it_agrees_better_with_the_silhouette(ball: Mesh) -> None:
    """A pointed object from a ball: no scaling can do it."""
    pointed = Mesh(ball.vertices * (0.6 + ball.vertices[:, :1]) * torch.tensor([1.0, 0.8, 0.8]), ball.faces)
    views = [view_of(pointed)]
    config = replace(SHORT, stages=(Stage(60, 64, 1e-4),), learning_rate=5e-4)
    result = refine(ball, views, config)
    assert result.silhouette_iou_before == mean_silhouette_iou(ball, views)
    assert result.silhouette_iou_after == mean_silhouette_iou(result.mesh, views)
    assert result.silhouette_iou_after > result.silhouette_iou_before + 0.1
    assert result.loss_curve["total"][result.best_iteration - 1] < 0.8 * result.loss_curve["total"][0]


def test_the_network_improves_what_no_scaling_can(ball: Mesh) -> None:
    pointed = Mesh(ball.vertices * (0.6 + ball.vertices[:, :1]), ball.faces)
    coarse = stretched(ball, 0.6, 0.6, 0.6)
    config = replace(SHORT, proportions=None, stages=(Stage(60, 64, 1e-4),), learning_rate=5e-4)
    config = replace(config, unexplained_depth=None)  # a small motion does not explain this
    result = refine(coarse, [view_of(pointed)], config)
    assert result.silhouette_iou_after > result.silhouette_iou_before + 0.03


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("scale", [1000.0, 0.001])
def test_units_and_place_do_not_matter(ball: Mesh, projection: str, scale: float) -> None:
    """Mesh and camera scaled and moved along together."""
    camera = CAMERA
    shift = scale * torch.tensor([3.0, -2.0, 5.0])
    matrix = camera.world_to_camera.clone()
    matrix[:3, 3] = matrix[:3, 3] * scale - matrix[:3, :3] @ shift
    moved_camera = replace(camera, world_to_camera=matrix)
    if projection == "orthographic":
        camera = replace(camera, projection="orthographic", fx=40.0, fy=40.0)
        moved_camera = replace(moved_camera, projection="orthographic", fx=40.0 / scale, fy=40.0 / scale)
    silhouette = hard_silhouette(stretched(ball, 1.2, 0.8, 1.0), camera).float()
    moved = Mesh(ball.vertices * scale + shift, ball.faces)
    for config, tolerance in ((SETTLED, 0.25), (GENTLE, 0.02)):
        here = refine(ball, [View(silhouette, camera)], config)
        there = refine(moved, [View(silhouette, moved_camera)], config)
        check(there, moved, config)
        back = (there.mesh.vertices - shift) / scale
        difference = (back - here.mesh.vertices).norm(dim=1).mean()
        assert float(difference) < tolerance * float(here.displacement.norm(dim=1).mean())
        assert offset_of(there) / scale == pytest.approx(5.0 + offset_of(here), abs=0.02)


def pieces(ball: Mesh) -> Mesh:
    other = 0.3 * ball.vertices + torch.tensor([0.7, 0.1, 0.0])
    return Mesh(torch.cat([ball.vertices, other]), torch.cat([ball.faces, ball.faces + 162]))


def open_shell(ball: Mesh) -> Mesh:
    return Mesh(ball.vertices, ball.faces[ball.vertices[ball.faces].mean(1)[:, 1] < 0.2])


def with_a_sheet(ball: Mesh) -> Mesh:
    """A third face on each of forty edges."""
    tips = 1.3 * ball.vertices[ball.faces[:40]].mean(1)
    sheet = torch.cat([ball.faces[:40, :2], 162 + torch.arange(40)[:, None]], 1)
    return Mesh(torch.cat([ball.vertices, tips]), torch.cat([ball.faces, sheet]))


def inside_out(ball: Mesh) -> Mesh:
    return Mesh(ball.vertices, ball.faces.flip(1))


def half_inside_out(ball: Mesh) -> Mesh:
    return Mesh(ball.vertices, torch.cat([ball.faces[:160], ball.faces[160:].flip(1)]))


def with_degenerate_faces(ball: Mesh) -> Mesh:
    """Repeated corners, a face stored twice, and T-junctions: faces on an edge and its middle."""
    edges = ball.faces[:30, :2]
    middles = ball.vertices[edges].mean(1)
    flat = torch.cat([edges, 162 + torch.arange(30)[:, None]], 1)
    points = torch.tensor([[0, 0, 1], [5, 5, 5]])
    faces = torch.cat([ball.faces, flat, points, ball.faces[:2]])
    return Mesh(torch.cat([ball.vertices, middles]), faces)


def one_triangle(ball: Mesh) -> Mesh:
    return Mesh(
        torch.tensor([[-0.5, -0.3, 0.1], [0.5, -0.3, 0.0], [0.0, 0.5, -0.1]]), torch.tensor([[0, 1, 2]])
    )


MESHES = [pieces, open_shell, with_a_sheet, inside_out, half_inside_out, with_degenerate_faces, one_triangle]


@pytest.mark.parametrize("make_mesh", MESHES)
def test_meshes_as_they_come(ball: Mesh, make_mesh: Callable[[Mesh], Mesh]) -> None:
    mesh = make_mesh(ball)
    views = [view_of(stretched(mesh, 1.2, 0.8, 1.0))]
    result = refine(mesh, views, SETTLED)
    check(result, mesh)
    assert result.silhouette_iou_after > result.silhouette_iou_before


def test_winding_does_not_matter(ball: Mesh, views: list[View]) -> None:
    one, other = (refine(mesh, views, GENTLE) for mesh in (ball, inside_out(ball)))
    difference = (one.mesh.vertices - other.mesh.vertices).norm(dim=1).mean()
    assert float(difference) < 0.02 * float(one.displacement.norm(dim=1).mean())


def test_degenerate_faces_do_not_stop_the_others(ball: Mesh, views: list[View]) -> None:
    """They have no normal to keep consistent: one alone once took all the steps."""
    config = replace(SHORT, proportions=None, stages=(Stage(40, 48, 3e-4),), learning_rate=5e-4)
    clean, awkward = (refine(mesh, views, config) for mesh in (ball, with_degenerate_faces(ball)))
    gain = clean.silhouette_iou_after - clean.silhouette_iou_before
    assert gain > 0.01
    assert awkward.silhouette_iou_after - awkward.silhouette_iou_before > gain / 2


@pytest.mark.parametrize("place", [0.0, 50.0])
def test_vertices_without_a_face_stay_and_change_nothing(ball: Mesh, views: list[View], place: float) -> None:
    extra = torch.tensor([[place, 0.1, 0.0], [0.0, -place, place]])
    with_extra = Mesh(torch.cat([extra[:1], ball.vertices, extra[1:]]), ball.faces + 1)
    expected, result = refine(ball, views, SHORT), refine(with_extra, views, SHORT)
    check(result, with_extra)
    assert torch.equal(result.mesh.vertices[1:-1], expected.mesh.vertices)
    assert torch.equal(result.mesh.vertices[[0, -1]], extra)


def test_two_views(ball: Mesh) -> None:
    """The second says how deep the object is, which the first does not see."""
    truth = stretched(ball, 1.0, 1.0, 1.6)
    front, right = Camera.look_at(0, 0, 1.9, 50, 64, 64), Camera.look_at(90, 0, 1.9, 50, 80, 60)

    def depth(*cameras: Camera) -> float:
        views = [view_of(truth, camera) for camera in cameras]
        result = refine(ball, views, SETTLED)
        check(result, ball)
        low, high = result.mesh.vertices[:, 2].aminmax()
        return float(high - low)

    assert depth(front, right) > depth(front) + 0.2


def test_orthographic_camera(ball: Mesh) -> None:
    camera = replace(CAMERA, projection="orthographic", fx=40.0, fy=40.0)
    result = refine(ball, [view_of(stretched(ball, 1.2, 0.8, 1.0), camera)], SHORT)
    check(result, ball)
    assert result.silhouette_iou_after > result.silhouette_iou_before


def test_the_plane_of_symmetry_that_was_used(ball: Mesh, views: list[View]) -> None:
    lifted = Mesh(ball.vertices + torch.tensor([0.0, 0.0, 0.05]), ball.faces)
    found = refine(lifted, views, replace(SHORT, proportions=None))
    assert offset_of(found) == pytest.approx(0.05, abs=0.01)
    given = refine(lifted, views, replace(SHORT, symmetry_offset=0.02))
    assert offset_of(given) == pytest.approx(0.02, abs=1e-5)


def test_confidence_falls_where_the_mesh_is_not_symmetric(ball: Mesh) -> None:
    """A bump on one side that the silhouette asks to keep."""
    bump: Tensor = (ball.vertices[:, 2] > 0.35)[:, None] * torch.tensor([0.0, 0.0, 0.3])
    bumpy = Mesh(ball.vertices + bump, ball.faces)
    config = replace(
        SHORT, proportions=None, stages=(Stage(40, 48, 3e-4),), symmetry_offset=0.0, learning_rate=5e-4
    )
    confidence = refine(bumpy, [view_of(bumpy)], config).confidence
    on_bump, elsewhere = (
        confidence[bump[:, 2] > 0],
        confidence[(bump[:, 2] == 0) & (ball.vertices[:, 2] > -0.3)],
    )
    assert float(on_bump.mean()) < float(elsewhere.mean())


def test_what_is_hidden_is_not_taken_for_background(ball: Mesh) -> None:
    """A third of a long ball is behind something: the rest is fitted as if all were seen."""
    wanted = view_of(stretched(ball, 1.2, 0.8, 1.0))
    known = torch.ones(64, 64, dtype=torch.bool)
    known[:, 38:] = False
    hidden = View(wanted.silhouette * known, CAMERA, known)
    kept, lost = (refine(ball, [view], SETTLED) for view in (hidden, replace(hidden, known=None)))
    shown = [mean_silhouette_iou(result.mesh, [wanted]) for result in (kept, lost)]
    assert shown[0] > shown[1] + 0.05, shown
    assert kept.silhouette_iou_after == pytest.approx(mean_silhouette_iou(kept.mesh, [hidden]))


def test_knowing_all_pixels_is_not_to_say_which(ball: Mesh, views: list[View]) -> None:
    all_known = [replace(view, known=torch.ones(64, 64, dtype=torch.bool)) for view in views]
    assert same(refine(ball, views, SHORT), refine(ball, all_known, SHORT))


class Memory:
    """Checkpoints as bytes, after every iteration."""

    def __init__(self, last: bytes | None = None) -> None:
        self.kept = [] if last is None else [last]

    def last(self) -> Snapshot | None:
        return torch.load(io.BytesIO(self.kept[-1]), weights_only=True) if self.kept else None

    def due(self) -> bool:
        return True

    def keep(self, snapshot: Snapshot) -> None:
        file = io.BytesIO()
        torch.save(snapshot, file)
        self.kept.append(file.getvalue())


@pytest.mark.parametrize("train_encoder", [False, True])
def test_a_run_that_goes_on_from_a_checkpoint_has_the_result_of_one_that_was_not_disturbed(
    ball: Mesh, views: list[View], train_encoder: bool
) -> None:
    """From any iteration, the last ones of stages included."""
    config = replace(SHORT, train_encoder=train_encoder)
    memory = Memory()
    undisturbed = refine(ball, views, config, checkpoints=memory)
    assert same(undisturbed, refine(ball, views, config))
    assert len(memory.kept) == config.iterations
    for iteration in (1, 3, 4, 5, 11, 12):
        rest = Memory(memory.kept[iteration - 1])
        resumed = refine(ball, views, config, checkpoints=rest)
        assert same(resumed, undisturbed), iteration
        assert resumed.best_iteration == undisturbed.best_iteration
        assert len(rest.kept) == 1 + config.iterations - iteration
