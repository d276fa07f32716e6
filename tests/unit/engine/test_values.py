"""What a Mesh, a Camera and a View refuse to be, and what they say about it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from refine_engine.errors import CameraInvalid, MeshInvalid, SilhouetteInvalid
from refine_engine.values import Camera, Mesh, View

CORNERS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FACES = torch.tensor([[0, 1, 2]])
CAMERA = Camera.look_at(30, 20, 1.9, 60, 4, 3)


def with_corner(value: float) -> Tensor:
    corners = CORNERS.clone()
    corners[1, 2] = value
    return corners


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        (CORNERS.double(), FACES, r"vertices \(V, 3\) float32, got \(3, 3\) torch.float64"),
        (CORNERS[:, :2], FACES, r"vertices \(V, 3\) float32, got \(3, 2\)"),
        (CORNERS.ravel(), FACES, r"vertices \(V, 3\) float32, got \(9,\)"),
        (CORNERS, FACES.int(), r"faces \(F, 3\) int64, got \(1, 3\) torch.int32"),
        (CORNERS, FACES[:, :2], r"faces \(F, 3\) int64, got \(1, 2\)"),
        (CORNERS, FACES[0], r"faces \(F, 3\) int64, got \(3,\)"),
        (CORNERS, FACES[:0], "at least one triangle"),
        (with_corner(math.nan), FACES, r"NaN or infinity in 1 of 3 vertices \(first: 1\)"),
        (with_corner(math.inf), FACES, r"NaN or infinity in 1 of 3 vertices \(first: 1\)"),
        (CORNERS, FACES + 1, "face indices from 0 to 2, got 1 to 3"),
        (CORNERS, FACES - 1, "face indices from 0 to 2, got -1 to 1"),
        (0 * CORNERS, FACES, "an object with a size"),
        (
            torch.cat([0 * CORNERS, CORNERS]),
            FACES,
            "an object with a size",
        ),  # vertices without a face do not count
    ],
)
def test_no_mesh(vertices: Tensor, faces: Tensor, says: str) -> None:
    with pytest.raises(MeshInvalid, match=says):
        Mesh(vertices, faces)


def posed(**change: float) -> Tensor:
    """The camera's matrix with one number changed: r<row><column>."""
    matrix = CAMERA.world_to_camera.clone()
    for name, value in change.items():
        matrix[int(name[1]), int(name[2])] = value
    return matrix


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"world_to_camera": torch.eye(3)}, r"a finite 4x4 world_to_camera, got shape \(3, 3\)"),
        ({"world_to_camera": posed(r03=math.nan)}, "a finite 4x4 world_to_camera"),
        (
            {"world_to_camera": posed(r00=0.5)},
            "an orthonormal rotation in world_to_camera, got one that is off by",
        ),
        ({"world_to_camera": CAMERA.world_to_camera * torch.tensor([[-1.0], [1], [1], [1]])}, "right-handed"),
        ({"fx": 0.0}, "positive fx, fy, got fx=0.0"),
        ({"fy": -1.0}, "positive fx, fy, got fx=.* fy=-1.0"),
        ({"fy": math.inf}, "finite intrinsics"),
        ({"cx": math.nan}, "finite intrinsics"),
        ({"cy": math.inf}, "finite intrinsics"),
        ({"width": 0}, "a positive image size, got 0x3"),
        ({"height": 0}, "a positive image size, got 4x0"),
    ],
)
def test_no_camera(change: dict[str, Tensor | float | int], says: str) -> None:
    with pytest.raises(CameraInvalid, match=says):
        replace(CAMERA, **change)  # type: ignore[arg-type]


HALF = torch.tensor([[1.0, 1, 0, 0]] * 3)


@pytest.mark.parametrize(
    ("silhouette", "says"),
    [
        (HALF.double(), r"\(H, W\) float32, got \(3, 4\) torch.float64"),
        (HALF[None], r"\(H, W\) float32, got \(1, 3, 4\)"),
        (HALF.T.contiguous(), "the camera's size 4x3, got 3x4"),
        (0.5 * HALF, "no pixel above the threshold"),
        (0.4 * HALF + 0.6, "background around the object"),
    ],
)
def test_no_view(silhouette: Tensor, says: str) -> None:
    with pytest.raises(SilhouetteInvalid, match=says):
        View(silhouette, CAMERA)


@pytest.mark.parametrize(
    ("known", "says"),
    [
        (HALF > 2, "pixels that are known, got none"),
        (HALF < 1, "no pixel above the threshold"),
        (HALF > 0, "background around the object"),
        (HALF, r"known pixels \(3, 4\) bool, got \(3, 4\) torch.float32"),
        (HALF[:2] > 0, r"known pixels \(3, 4\) bool, got \(2, 4\)"),
    ],
)
def test_only_known_pixels_are_an_object_or_background(known: Tensor, says: str) -> None:
    with pytest.raises(SilhouetteInvalid, match=says):
        View(HALF, CAMERA, known)


def test_the_object_is_what_is_known_of_it() -> None:
    known = torch.ones(3, 4, dtype=torch.bool)
    known[0] = False
    assert torch.equal(View(HALF, CAMERA, known).object(), (HALF > 0) & known)
    assert torch.equal(View(HALF, CAMERA).to("cpu").object(), HALF > 0)


def test_the_least_that_is_enough() -> None:
    corner = torch.zeros(3, 4)
    corner[0, 0] = 1
    assert View(corner, CAMERA).camera is CAMERA
    assert View(1 - corner, CAMERA).camera is CAMERA
    assert len(Mesh(CORNERS, FACES).faces) == 1


@pytest.mark.parametrize(("distance", "seen"), [(1.5, True), (30.0, False), (1e4, False)])
def test_a_stray_fragment_far_away_does_not_set_the_box(ball: Mesh, distance: float, seen: bool) -> None:
    crumb = 0.01 * CORNERS + torch.tensor([distance, 0.0, 0.0])
    mesh = Mesh(torch.cat([ball.vertices, crumb]), torch.cat([ball.faces, FACES + len(ball.vertices)]))
    low, high = mesh.box()
    assert torch.equal(low, ball.vertices.amin(0))
    assert torch.equal(high, mesh.vertices.amax(0) if seen else ball.vertices.amax(0))


def test_the_box_of_a_mesh_without_strays_is_its_bounding_box(ball: Mesh) -> None:
    for mesh in (ball, Mesh(CORNERS, FACES), Mesh(ball.vertices * torch.tensor([50.0, 1, 1]), ball.faces)):
        low, high = mesh.box()
        assert torch.equal(low, mesh.vertices.amin(0))
        assert torch.equal(high, mesh.vertices.amax(0))


def test_the_box_of_a_mesh_is_found_once(ball: Mesh) -> None:
    """It sorts all triangles, and every picture asks for it."""
    assert ball.to("cpu") is ball
    assert ball.box()[0] is ball.box()[0]
