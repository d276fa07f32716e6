"""Cameras estimated from the silhouette of a mesh that is exactly right, so that the answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
import trimesh

from refine_engine.cameras.seen import hard_silhouette, silhouette_iou
from refine_engine.errors import SilhouetteInvalid
from refine_engine.estimation.cutout import Cutout
from refine_engine.estimation.estimate import (
    ALTERNATIVES,
    APART_DEGREES,
    Candidate,
    Hint,
    angles,
    estimate_camera,
    mirrored,
)
from refine_engine.estimation.place import extreme_points, place, sphere
from refine_engine.estimation.polish import difference, polish
from refine_engine.estimation.poses import Poses, rotations
from refine_engine.values import Camera, Mesh, View

WIDTH, HEIGHT, FOV = 160, 120, 50.0


def boxes(*bounds: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """One mesh of axis-aligned boxes."""
    parts = [trimesh.creation.box(bounds=pair).subdivide() for pair in bounds]
    starts = [sum(len(part.vertices) for part in parts[:i]) for i in range(len(parts))]
    vertices = torch.cat([torch.tensor(part.vertices).float() for part in parts])
    faces = torch.cat([torch.tensor(part.faces).long() + at for part, at in zip(parts, starts, strict=True)])
    return Mesh(vertices, faces)


SEAT = ((-0.3, 0.0, -0.3), (0.3, 0.1, 0.3))
BACK = ((-0.3, 0.1, -0.3), (-0.2, 0.6, 0.3))
ARM = ((-0.2, 0.1, 0.2), (0.2, 0.3, 0.3))
CHAIR = boxes(SEAT, BACK, ARM)  # mirrored by nothing
SYMMETRIC = boxes(SEAT, BACK)  # by z = 0


def seen(mesh: Mesh, camera: Camera) -> torch.Tensor:
    return hard_silhouette(mesh, camera).float()


def off(mesh: Mesh, found: Candidate, camera: Camera) -> float:
    """Degrees between the directions from the middle of the mesh to two cameras."""
    middle = sum(mesh.box()) / 2
    one, other = (
        F.normalize(-pose[:3, :3].T @ pose[:3, 3] - middle, dim=0)
        for pose in (found.camera.world_to_camera, camera.world_to_camera)
    )
    return math.degrees(math.acos(min(1.0, float(one @ other))))


@pytest.mark.parametrize(("azimuth", "elevation"), [(40, 20), (-100, 35), (160, 5), (0, 30)])
@pytest.mark.parametrize("fov", [FOV, None])
def test_the_camera_of_a_right_mesh_is_found(azimuth: float, elevation: float, fov: float | None) -> None:
    camera = Camera.look_at(azimuth, elevation, 1.8, FOV, WIDTH, HEIGHT)
    found = estimate_camera(CHAIR, seen(CHAIR, camera), hint=Hint(fov))
    assert off(CHAIR, found[0], camera) < 6
    assert found[0].silhouette_iou > 0.9
    assert (found[0].camera.width, found[0].camera.height) == (WIDTH, HEIGHT)
    if fov is not None:
        assert found[0].camera.fy == pytest.approx(camera.fy)
    told = (found[0].azimuth_degrees - azimuth + 180) % 360 - 180, found[0].elevation_degrees - elevation
    assert max(map(abs, told)) < 14  # the chair is not at the origin


def test_alternatives_are_other_directions() -> None:
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    found = estimate_camera(CHAIR, seen(CHAIR, camera))
    assert 1 < len(found) <= 1 + ALTERNATIVES
    assert all(off(CHAIR, other, found[0].camera) > APART_DEGREES for other in found[1:])
    for one in found:
        assert one.silhouette_iou == silhouette_iou(CHAIR, View(seen(CHAIR, camera), one.camera))
    assert not found[0].mirror_ambiguous


def test_the_unit_of_length_and_the_place_of_the_object_do_not_matter() -> None:
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    silhouette = seen(CHAIR, camera)
    moved = Mesh(CHAIR.vertices * 1000 + torch.tensor([5e3, -2e3, 1e3]), CHAIR.faces)
    here, there = (estimate_camera(mesh, silhouette, hint=Hint(FOV))[0] for mesh in (CHAIR, moved))
    assert there.azimuth_degrees == pytest.approx(here.azimuth_degrees, abs=1)
    assert there.silhouette_iou == pytest.approx(here.silhouette_iou, abs=0.01)


def test_an_object_beside_the_middle_of_the_image_is_seen_from_where_it_is_seen() -> None:
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    pose = camera.world_to_camera.clone()
    pose[0, 3] += 0.4
    camera = replace(camera, world_to_camera=pose)
    found = estimate_camera(CHAIR, seen(CHAIR, camera), hint=Hint(FOV))
    assert off(CHAIR, found[0], camera) < 6


def test_a_known_roll_is_kept() -> None:
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    a = math.radians(25)
    roll = torch.eye(4)
    roll[:2, :2] = torch.tensor([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])
    camera = replace(camera, world_to_camera=roll @ camera.world_to_camera)
    found = estimate_camera(CHAIR, seen(CHAIR, camera), hint=Hint(FOV, roll_degrees=25))
    assert off(CHAIR, found[0], camera) < 6


def test_a_symmetric_object_from_far_away_is_ambiguous_and_a_hint_decides() -> None:
    """From (a, e) and from the mirrored other side, (-a, -e) for z = 0, it looks the same."""
    camera = Camera.look_at(60, 30, 20.0, 3.0, WIDTH, HEIGHT)
    silhouette = seen(SYMMETRIC, camera)
    found = estimate_camera(SYMMETRIC, silhouette, hint=Hint(3.0))
    assert off(SYMMETRIC, found[0], camera) < 6  # cameras are above the ground as a rule
    twins = [one for one in found if one.mirror_ambiguous]
    assert twins
    assert min(one.elevation_degrees for one in twins) == pytest.approx(-30, abs=10)
    told = estimate_camera(SYMMETRIC, silhouette, hint=Hint(3.0, elevation_degrees=-40))
    assert told[0].elevation_degrees == pytest.approx(-30, abs=10)


def test_unknown_pixels_say_nothing() -> None:
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    silhouette, known = seen(CHAIR, camera), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    known[52:66, 70:90] = False
    silhouette[~known] = 0.0
    assert off(CHAIR, estimate_camera(CHAIR, silhouette, known, Hint(FOV))[0], camera) < 6


def test_a_silhouette_without_an_object_is_refused() -> None:
    with pytest.raises(SilhouetteInvalid):
        estimate_camera(CHAIR, torch.zeros(HEIGHT, WIDTH))


def test_an_object_is_placed_in_the_box_of_its_silhouette() -> None:
    points = extreme_points(CHAIR.vertices)
    directions = sphere(50)
    rotation = rotations(directions, 10.0, torch.tensor([0.3, -0.2, 1.0]).expand(50, 3))
    lens = torch.tensor([[60.0, 32.0, 30.0]]).expand(50, 3)
    box = torch.tensor([20.0, 10.0, 50.0, 40.0])
    camera = points @ rotation.transpose(1, 2) + place(points, rotation, lens, box)[:, None]
    drawn = camera[..., :2] / camera[..., 2:] * 60 + torch.tensor([32.0, 30.0])
    low, high = drawn.amin(1), drawn.amax(1)
    assert torch.allclose((low + high) / 2, torch.tensor([35.0, 25.0]).expand(50, 2), atol=0.5)
    assert torch.allclose((high - low).prod(1), torch.tensor(900.0), rtol=0.05)


def test_a_small_picture_agrees_with_the_whole_image() -> None:
    """The 2D IoU of cut-outs, drawn all at once, against `silhouette_iou` of one camera after the other."""
    middle = sum(CHAIR.box()) / 2
    mesh = Mesh(CHAIR.vertices - middle, CHAIR.faces)
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    silhouette = seen(mesh, camera)
    cutout = Cutout.of(silhouette > 0.5, None, 64)
    poses = Poses.of(mesh, cutout, sphere(30), FOV, 0.0)
    for i, score in enumerate(poses.overlap(mesh, cutout).tolist()):
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = poses.rotation[i], poses.translation[i]
        view = View(silhouette, replace(camera, world_to_camera=pose))
        assert score == pytest.approx(silhouette_iou(mesh, view), abs=0.05)


def test_polishing_never_makes_a_pose_worse() -> None:
    camera = Camera.look_at(40, 20, 1.8, FOV, WIDTH, HEIGHT)
    cutout = Cutout.of(seen(CHAIR, camera) > 0.5, None, 64)
    poses = Poses.of(CHAIR, cutout, sphere(6), FOV, 0.0)
    after = polish(poses, CHAIR, cutout, 0.0, lens_known=True)
    before, now = (difference(some, CHAIR, cutout) for some in (poses, after))
    assert (now <= before).all()
    assert (now < before).any()
    assert torch.equal(after.fov_y_degrees, poses.fov_y_degrees)


def test_directions_and_their_mirror_images() -> None:
    directions = sphere(600)
    assert torch.allclose(directions.norm(dim=1), torch.ones(600))
    azimuth, elevation = angles(torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]))
    assert azimuth[[0, 2]].abs().tolist() == [90, 180]
    assert elevation.tolist() == [0, 90, 0]
    one = F.normalize(torch.tensor([1.0, 2.0, 3.0]), dim=0)
    same, behind, other = mirrored(one, torch.tensor([0.0, 0.0, 1.0]))
    assert torch.allclose(other, one * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.allclose(behind, -one)
    assert torch.allclose(same, -other)
    assert torch.equal(mirrored(one, None), -one[None])


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (120, 40), (-70, -89), (0, 90), (0, -90)])
def test_a_camera_in_a_direction_is_the_one_that_looks_at(azimuth: float, elevation: float) -> None:
    camera = Camera.look_at(azimuth, elevation, 2.0, FOV, 10, 10)
    rotation = camera.world_to_camera[:3, :3]
    found = rotations(-rotation[2:], 0.0, torch.tensor([[0.0, 0.0, 1.0]]))[0]
    assert torch.allclose(found, rotation, atol=1e-5)
