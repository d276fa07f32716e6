"""The metrics against closed forms, and against the independent scorer where it is present."""

import importlib.util
import json
import math
import os
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import trimesh

from refine_engine.cameras.seen import silhouette_iou
from refine_engine.errors import MeshInvalid
from refine_engine.scores import scores
from refine_engine.scores.scores import (
    SurfacePoints,
    chamfer_l2,
    earth_mover_distance,
    evaluate,
    f_score,
    nearest_distances,
    sample_surface,
    volumetric_iou,
)
from refine_engine.scores.winding import winding_numbers
from refine_engine.values import Camera, Mesh, View

ROOT = Path(__file__).resolve().parents[4]
SHARED = Path(os.environ.get("REFINE_SHARED", ROOT.parent / "shared"))
SAMPLES = ROOT / "examples" / "samples"


def as_mesh(shape: trimesh.Trimesh) -> Mesh:
    vertices, faces = np.array(shape.vertices, np.float32), np.array(shape.faces, np.int64)
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


def cube(x: float = 0.0) -> trimesh.Trimesh:
    """The unit cube, moved along x."""
    box: trimesh.Trimesh = trimesh.creation.box()
    box.apply_translation([x, 0.0, 0.0])
    return box


def ball(radius: float = 1.0) -> trimesh.Trimesh:
    sphere: trimesh.Trimesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return sphere


def corners(shape: trimesh.Trimesh) -> np.ndarray:
    return np.asarray(shape.triangles, dtype=np.float64)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_samples_lie_on_the_surface_and_are_uniform_by_area() -> None:
    points = sample_surface(corners(cube()), 60_000, rng())
    assert np.allclose(np.abs(points).max(1), 0.5)
    side = np.argmax(np.abs(points), 1) * 2 + (points[np.arange(len(points)), np.abs(points).argmax(1)] > 0)
    assert np.allclose(np.bincount(side) / len(points), 1 / 6, atol=0.005)
    top = points[side == 3][:, [0, 2]]
    assert np.allclose(top.var(0), 1 / 12, rtol=0.03)  # of a uniform distribution on [-1/2, 1/2]


def test_distances_of_shifted_points_by_hand() -> None:
    cloud = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    reference = np.array([[0.0, 0.04, 0.0], [1.0, 0.1, 0.0]])
    distances = nearest_distances(cloud, reference)
    assert np.allclose(distances, [[0.04, 0.1], [0.04, 0.1]])
    assert chamfer_l2(*distances) == pytest.approx(1000 * 2 * (0.04**2 + 0.1**2) / 2)
    assert f_score(*distances) == pytest.approx(50.0)
    assert f_score(np.array([0.01, 0.01]), np.array([0.01, 0.2])) == pytest.approx(100 * 2 * 0.5 / 1.5)
    assert f_score(np.array([1.0]), np.array([1.0])) == 0.0


def test_emd_of_a_translated_cloud_is_the_shift() -> None:
    cloud = rng().normal(size=(500, 3))
    shuffled = rng().permutation(cloud) + np.array([0.3, 0.0, 0.4])
    assert earth_mover_distance(cloud, shuffled) == pytest.approx(0.5)  # translation is an optimal plan


def test_emd_assigns_one_to_one() -> None:
    cloud, reference = np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.array([[0.0, 0, 0], [5.0, 0, 0]])
    assert earth_mover_distance(cloud, reference) == pytest.approx(4.9 / 2)
    with pytest.raises(ValueError, match="clouds of one size"):
        earth_mover_distance(cloud, reference[:1])


def test_winding_numbers_agree_with_the_exact_sum() -> None:
    triangles = corners(ball())
    points = rng().uniform(-2, 2, (200, 3))
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    up = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    down = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    exact = 2 * np.arctan2(up, down).sum(1) / (4 * math.pi)
    assert np.abs(winding_numbers(triangles, points) - exact).max() < 0.05


def test_winding_number_of_an_open_half_ball_at_its_centre_is_one_half() -> None:
    triangles = corners(ball())
    half = triangles[triangles.mean(1)[:, 2] > 0]
    centre = np.zeros((1, 3))
    assert winding_numbers(half, centre)[0] == pytest.approx(0.5, abs=0.02)
    assert winding_numbers(half[:, ::-1], centre)[0] == pytest.approx(-0.5, abs=0.02)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (cube(), cube(), 1.0),
        (cube(), cube(0.5), 1 / 3),
        (cube(), cube(2.0), 0.0),
        (ball(1.0), ball(0.8), 0.8**3),
        (trimesh.creation.box((2, 2, 2)), ball(1.0), math.pi / 6),
    ],
)
def test_volumetric_iou_of_known_solids(
    first: trimesh.Trimesh, second: trimesh.Trimesh, expected: float
) -> None:
    assert volumetric_iou(corners(first), corners(second), rng()) == pytest.approx(expected, abs=0.012)


def test_volumetric_iou_survives_holes_and_inverted_winding() -> None:
    whole = corners(ball())
    holed = whole[np.arange(len(whole)) % 400 > 20]
    assert volumetric_iou(holed, whole, rng()) > 0.93
    assert volumetric_iou(whole[:, ::-1], whole, rng()) == 1.0


def test_a_mesh_scores_perfectly_against_itself_up_to_sampling() -> None:
    perfect = evaluate(as_mesh(ball()), as_mesh(ball()), seeds=[0])
    assert perfect.f_score == pytest.approx(100.0, abs=0.5)
    assert perfect.chamfer_l2 < 1.5
    assert perfect.emd < 0.12
    assert perfect.volumetric_iou == 1.0
    assert perfect.silhouette_iou is None


@pytest.mark.usefixtures("few_emd_points")
def test_normalisations_differ_in_what_they_forgive() -> None:
    small, large, moved = as_mesh(ball(0.5)), as_mesh(ball(1.0)), as_mesh(cube(3.0))
    own, shared = evaluate(small, large, normalisation="own", seeds=[0]), evaluate(small, large, seeds=[0])
    assert own.f_score > 99
    assert own.volumetric_iou is not None
    assert own.volumetric_iou > 0.99
    assert shared.f_score == 0
    assert shared.chamfer_l2 == pytest.approx(1000 * 2 * 0.5**2, rel=0.05)
    assert evaluate(moved, moved, seeds=[0]).f_score > 95  # the frame's place is no error
    far = evaluate(moved, as_mesh(cube()), seeds=[0], normalisation="own")
    assert far.volumetric_iou == 0.0  # but a place that differs is, in both


def test_points_may_be_the_truth() -> None:
    """4,000 points of a ball against a ball of 0.9 times its radius: as good a truth as the ball itself."""
    truth, smaller = as_mesh(ball()), as_mesh(ball(0.9))
    points = torch.from_numpy(
        sample_surface(corners(ball()), 4_000, np.random.default_rng(7)).astype(np.float32)
    )
    by_mesh, by_points = (evaluate(smaller, t, seeds=[0]) for t in (truth, SurfacePoints(points)))
    assert by_points.chamfer_l2 == pytest.approx(by_mesh.chamfer_l2, rel=0.05)
    assert by_points.f_score == pytest.approx(by_mesh.f_score, abs=1.0)
    assert by_points.emd == pytest.approx(by_mesh.emd, rel=0.1)
    assert by_points.volumetric_iou is None
    few = evaluate(smaller, SurfacePoints(points[:50]), seeds=[0], normalisation="own")
    assert few.emd > by_points.emd  # of 50 points each
    for wrong in (points[:0], points[:, :2], points.double(), points * float("nan")):
        with pytest.raises(MeshInvalid, match="surface points"):
            SurfacePoints(wrong)


@pytest.mark.usefixtures("few_emd_points")
def test_same_seeds_same_scores() -> None:
    first, second = as_mesh(cube()), as_mesh(ball(0.6))
    assert evaluate(first, second, seeds=[3]) == evaluate(first, second, seeds=[3])


def test_a_mesh_without_area_is_refused() -> None:
    line = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), torch.tensor([[0, 1, 2]]))
    with pytest.raises(MeshInvalid, match="zero area"):
        evaluate(line, as_mesh(cube()))
    with pytest.raises(ValueError, match="at least one seed"):
        evaluate(as_mesh(cube()), as_mesh(cube()), seeds=[])


def test_2d_iou_of_squares() -> None:
    camera = Camera(torch.eye(4), 10.0, 10.0, 16.0, 16.0, 32, 32, "orthographic")
    box = as_mesh(cube())  # 10 x 10 pixels, x and y from 11 to 21
    silhouette = torch.zeros(32, 32)
    silhouette[11:21, 11:21] = 1.0
    front = Mesh(box.vertices + torch.tensor([0.0, 0.0, 5.0]), box.faces)
    assert silhouette_iou(front, View(silhouette, camera)) == 1.0
    shifted = torch.roll(silhouette, 5, dims=1)
    assert silhouette_iou(front, View(shifted, camera)) == pytest.approx(1 / 3)


@pytest.fixture
def few_emd_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that do not look at the EMD: its exact assignment is most of what a score costs."""
    monkeypatch.setattr(scores, "EMD_POINTS", 64)


@pytest.fixture(scope="module")
def score() -> ModuleType:
    path = SHARED / "score.py"
    spec = importlib.util.spec_from_file_location("score", path)
    if not path.exists() or spec is None or spec.loader is None:
        pytest.skip("the independent scorer is not here")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.usefixtures("few_emd_points")
def test_numbers_agree_with_the_independent_scorer(score: ModuleType) -> None:
    coarse, truth = (score.load(SAMPLES / "airplane" / f"{which}.obj") for which in ("coarse", "gt"))
    theirs = score.distances(coarse, truth)
    shared = evaluate(as_mesh(coarse), as_mesh(truth))
    own = evaluate(as_mesh(coarse), as_mesh(truth), normalisation="own")
    ours = [shared.chamfer_l2, shared.f_score, own.chamfer_l2, own.f_score]
    assert np.allclose(ours, theirs, rtol=0.03)
    camera = json.loads((SAMPLES / "airplane" / "camera.json").read_text())
    theirs_2d = torch.from_numpy(score.silhouette(coarse, camera)).float()
    del camera["type"]
    view = View(theirs_2d, Camera.look_at(**camera, width=224, height=224))
    assert silhouette_iou(as_mesh(coarse), view) > 0.97  # Pillow draws outlines, an eighth of a pixel too fat
