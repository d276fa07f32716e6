"""The fit of the whole mesh: the camera that it corrects, the webs that it leaves out, the way to stop it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from refine_engine.cameras.seen import hard_silhouette
from refine_engine.errors import Cancelled
from refine_engine.method.config import ProportionFit, RefineConfig
from refine_engine.method.loop import refine
from refine_engine.method.proportions import turned
from refine_engine.method.whole_mesh import fit_whole_mesh
from refine_engine.values import Camera, Mesh, View

CAMERA = Camera.look_at(50, 25, 1.9, 45, 160, 120)


@pytest.fixture
def truth() -> Mesh:
    """Symmetric in z: a long body, and a fin above its end."""
    parts = []
    for size, place in (((0.9, 0.2, 0.3), (0.0, 0.0, 0.0)), ((0.2, 0.25, 0.06), (0.3, 0.26, 0.0))):
        box = trimesh.creation.box(size)
        box.apply_translation(place)
        parts.append(box.subdivide().subdivide())
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    vertices, faces = np.array(whole.vertices, np.float32), np.array(whole.faces, np.int64)
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


def angle_between(one: Tensor, other: Tensor) -> float:
    """Degrees between the rotations of two (4, 4) cameras."""
    cos = (float((one[:3, :3] @ other[:3, :3].T).trace()) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cos, -1, 1))))


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 0.6, 0.8)], ids=["rolled", "rolled and turned"])
def test_a_camera_that_is_off_turns_towards_the_truth(truth: Mesh, axis: tuple[float, float, float]) -> None:
    """By three degrees about the object."""
    off = turned(CAMERA.world_to_camera[None], torch.tensor(axis) * np.radians(3.0))[0]
    view = View(hard_silhouette(truth, CAMERA).float(), replace(CAMERA, world_to_camera=off))
    assert angle_between(off, CAMERA.world_to_camera) == pytest.approx(3.0, abs=0.05)
    config = RefineConfig(proportions=ProportionFit(camera_prior=1.0))
    fitted = fit_whole_mesh(truth, [view], config)
    corrected = fitted.views[0].camera.world_to_camera
    assert angle_between(corrected, CAMERA.world_to_camera) < 2.0
    assert fitted.camera_turn_degrees == pytest.approx(angle_between(corrected, off), abs=0.05)
    assert torch.equal(fitted.views[0].silhouette, view.silhouette)

    exact = fit_whole_mesh(truth, [view], RefineConfig())
    assert exact.camera_turn_degrees is None
    torch.testing.assert_close(exact.views[0].camera.world_to_camera, off, atol=1e-5, rtol=0)


def test_turned_keeps_the_origin_in_its_place() -> None:
    matrix = turned(CAMERA.world_to_camera[None], torch.tensor([0.1, -0.2, 0.3]))[0]
    torch.testing.assert_close(matrix[:, 3], CAMERA.world_to_camera[:, 3])
    torch.testing.assert_close(matrix[:3, :3] @ matrix[:3, :3].T, torch.eye(3), atol=1e-5, rtol=0)


def test_a_web_over_a_hole_is_not_there(truth: Mesh) -> None:
    """A frame seen straight on; the coarse mesh has a sheet across its hole."""
    camera = Camera.look_at(0, 0, 1.9, 45, 128, 128)
    grid = trimesh.creation.box((0.9, 0.9, 0.1)).subdivide().subdivide().subdivide()
    vertices = torch.from_numpy(np.array(grid.vertices, np.float32))
    coarse = Mesh(vertices, torch.from_numpy(np.array(grid.faces, np.int64)))
    inside = coarse.vertices[coarse.faces][..., :2].mean(1).abs().amax(1) < 0.2
    frame = Mesh(vertices, coarse.faces[~inside])
    view = View(hard_silhouette(frame, camera).float(), camera)
    whole = fit_whole_mesh(coarse, [view], RefineConfig())
    assert torch.equal(whole.mesh.faces, coarse.faces)
    assert not whole.there[inside].any()
    assert float(whole.there[~inside].float().mean()) > 0.95


def test_without_the_fit_nothing_is_left_out(truth: Mesh) -> None:
    views = [View(hard_silhouette(truth, CAMERA).float(), CAMERA)]
    whole = fit_whole_mesh(truth, views, RefineConfig.paper())
    assert whole.mesh is truth
    assert whole.there.all()
    assert whole.views == tuple(views)


def test_it_asks_before_every_iteration_and_can_be_stopped(truth: Mesh) -> None:
    views = [View(hard_silhouette(truth, CAMERA).float(), CAMERA)]
    coarse = Mesh(truth.vertices * torch.tensor([0.8, 1.2, 1.0]), truth.faces)
    config = RefineConfig(proportions=ProportionFit(iterations=7, render_size=32), agreement=None)
    asked = 0

    def proceed() -> None:
        nonlocal asked
        asked += 1

    fit_whole_mesh(coarse, views, config, proceed)
    assert asked in (7, 14)  # once, or again without the faces that lie outside
    questions = iter([False, False, True])
    with pytest.raises(Cancelled, match="cancelled after 0 of 100 iterations"):
        refine(coarse, views, config, cancelled=lambda: next(questions))
