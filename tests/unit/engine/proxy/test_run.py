"""Refining a mesh of many vertices by way of a proxy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from surfaces import grid, sphere

from refine_engine.cameras.seen import hard_silhouette, silhouette_iou
from refine_engine.method.config import ProportionFit, RefineConfig, Stage
from refine_engine.method.loop import refine
from refine_engine.proxy.run import MANY_VERTICES, PROXY_VERTICES, refine_any_size
from refine_engine.values import Camera, Mesh, Progress, View

CONFIG = RefineConfig(
    proportions=ProportionFit(iterations=20, render_size=64), stages=(Stage(6, 96, 1e-5),), encoder_size=32
)
CAMERA = Camera.look_at(40, 20, 1.9, 50, 128, 128)


def mesh_of(vertices: object, faces: object) -> Mesh:
    return Mesh(torch.from_numpy(np.asarray(vertices, np.float32)), torch.from_numpy(np.asarray(faces)))


@pytest.fixture(scope="module")
def ball() -> Mesh:
    """With two vertices that no face uses, one before the others and one behind them."""
    vertices, faces = sphere(MANY_VERTICES + 2000)
    return mesh_of([[3, 3, 3], *vertices, [4, 4, 4]], faces + 1)


def seen(mesh: Mesh, *scale: float) -> View:
    return View(
        hard_silhouette(Mesh(mesh.vertices * torch.tensor(scale), mesh.faces), CAMERA).float(), CAMERA
    )


def test_a_proxy_is_refined_and_the_mesh_follows(ball: Mesh) -> None:
    view, heard = seen(ball, 1.3, 0.7, 1.0), list[Progress]()
    result = refine_any_size(ball, [view], CONFIG, heard.append)
    assert result.proxy is not None
    assert (result.proxy.vertices, result.outcome) == (PROXY_VERTICES, "refined")
    assert result.silhouette_iou_before == silhouette_iou(ball, view) < 0.8
    assert result.silhouette_iou_after == silhouette_iou(result.mesh, view) > 0.9
    assert abs(result.silhouette_iou_after - result.proxy.silhouette_iou_after) < 0.01
    assert (heard[-1].iteration, result.mesh.vertices.shape) == (6, ball.vertices.shape)
    torch.testing.assert_close(result.displacement, result.mesh.vertices - ball.vertices)
    assert torch.equal(result.mesh.faces, ball.faces[result.kept_faces])
    assert ((result.confidence >= 0) & (result.confidence <= 1)).all()
    for unused in (0, -1):
        assert torch.equal(result.mesh.vertices[unused], ball.vertices[unused])
        assert result.confidence[unused] == 1


def test_a_mesh_that_agrees_comes_back_to_the_bit(ball: Mesh) -> None:
    result = refine_any_size(ball, [seen(ball, 1.0, 1.0, 1.0)], CONFIG)
    assert result.outcome == "kept"
    assert torch.equal(result.mesh.vertices, ball.vertices)
    assert result.kept_faces.all()


def test_a_small_mesh_is_refined_itself() -> None:
    small = mesh_of(*sphere(500))
    view = seen(small, 1.3, 0.7, 1.0)
    result, expected = refine_any_size(small, [view], CONFIG), refine(small, [view], CONFIG)
    assert result.proxy is None
    assert torch.equal(result.mesh.vertices, expected.mesh.vertices)


def test_a_hole_is_opened_in_the_mesh_where_it_is_in_the_proxy() -> None:
    """A plate whose silhouette has a round hole."""
    vertices, faces = grid(110, 110)
    plate = mesh_of(vertices - np.array([0.5, 0.5, 0]), faces)
    camera = Camera.look_at(0, 0, 2, 50, 192, 192)
    centres = plate.vertices[plate.faces].mean(1)
    hole = centres.norm(dim=1) < 0.2
    ring = Mesh(plate.vertices, plate.faces[~hole])
    result = refine_any_size(plate, [View(hard_silhouette(ring, camera).float(), camera)], CONFIG)
    removed = ~result.kept_faces
    assert result.proxy is not None
    assert (removed & hole).sum() > 0.8 * hole.sum()
    assert (removed & ~hole).sum() < 0.15 * hole.sum()
    assert result.silhouette_iou_after > 0.95
    assert abs(result.silhouette_iou_after - result.proxy.silhouette_iou_after) < 0.01


def test_the_unit_of_length_does_not_matter(ball: Mesh) -> None:
    """Nor where the mesh is. A ball has any mirror plane: it is told which."""
    scale, config = 1e-4, replace(CONFIG, symmetry="plane")

    def moved(mesh: Mesh) -> tuple[Mesh, Camera]:
        shift = torch.tensor([3.0, -2.0, 1.0])
        pose = CAMERA.world_to_camera.clone()
        pose[:3, 3] = scale * (pose[:3, 3] - pose[:3, :3] @ shift)
        camera = Camera(pose, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, 128, 128)
        return Mesh(scale * (mesh.vertices + shift), mesh.faces), camera

    view = seen(ball, 1.3, 0.7, 1.0)
    there, camera = moved(ball)
    expected = refine_any_size(ball, [view], config)
    result = refine_any_size(there, [View(view.silhouette, camera)], config)
    assert result.silhouette_iou_after == pytest.approx(expected.silhouette_iou_after, abs=0.01)
    apart = result.displacement / scale - expected.displacement
    assert apart.norm(dim=1).mean() < 0.03
