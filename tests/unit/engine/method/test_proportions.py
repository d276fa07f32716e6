"""A mesh that is the ground truth moved as a whole comes back, as far as the silhouette sees it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from refine_engine.cameras.seen import hard_silhouette, mean_silhouette_iou
from refine_engine.method.config import ProportionFit, RefineConfig
from refine_engine.method.presets import make_config
from refine_engine.method.proportions import Basis, vertex_normals
from refine_engine.method.symmetry import rotation_from_z
from refine_engine.method.whole_mesh import fit_whole_mesh
from refine_engine.values import Camera, Mesh, View

CONFIG = RefineConfig()


def boxes(*size_and_place: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """Separate boxes, each given by its size and its centre."""
    parts = []
    for size, place in size_and_place:
        box = trimesh.creation.box(size)
        box.apply_translation(place)
        parts.append(box.subdivide().subdivide())
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    vertices, faces = np.array(whole.vertices, np.float32), np.array(whole.faces, np.int64)
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


@pytest.fixture
def truth() -> Mesh:
    """Symmetric in z, in two pieces: a long body, and a fin above its end."""
    return boxes(((0.9, 0.2, 0.3), (0.0, 0.0, 0.0)), ((0.2, 0.25, 0.06), (0.3, 0.26, 0.0)))


CAMERA = Camera.look_at(50, 25, 1.9, 45, 160, 120)


def view_of(mesh: Mesh, camera: Camera = CAMERA) -> View:
    return View(hard_silhouette(mesh, camera).float(), camera)


def distance(mesh: Mesh, truth: Mesh) -> float:
    return float((mesh.vertices - truth.vertices).norm(dim=1).mean())


def linear(xx: float = 1, xy: float = 0, yx: float = 0, yy: float = 1, zz: float = 1) -> Tensor:
    return torch.tensor([[xx, xy, 0], [yx, yy, 0], [0, 0, zz]], dtype=torch.float32)


@pytest.mark.parametrize(
    ("matrix", "shift"),
    [
        (linear(xx=1.25), (0.0, 0.0, 0.0)),
        (linear(yy=0.7, zz=1.3), (0.0, 0.0, 0.0)),
        (linear(xy=0.3), (0.0, 0.0, 0.0)),
        (linear(), (0.0, 0.12, 0.0)),
        (linear(xx=0.8, yy=1.2, yx=-0.1), (0.05, 0.06, 0.0)),
    ],
    ids=["long", "flat and wide", "sheared", "shifted", "all"],
)
def test_what_the_silhouette_sees_comes_back(
    truth: Mesh, matrix: Tensor, shift: tuple[float, float, float]
) -> None:
    coarse = Mesh(truth.vertices @ matrix.T + torch.tensor(shift), truth.faces)
    views = [view_of(truth)]
    fitted = fit_whole_mesh(coarse, views, CONFIG).mesh
    assert torch.equal(fitted.faces, coarse.faces)
    before, after = (mean_silhouette_iou(mesh, views) for mesh in (coarse, fitted))
    assert after > 0.9
    assert after > before + 0.3 * (1 - before)
    assert distance(fitted, truth) < 0.75 * distance(coarse, truth)


def test_a_fat_mesh_gets_its_thickness_back() -> None:
    """Of a table: its legs, of a sixteenth of its width, came out nearly twice as thick, the rest hardly."""
    legs = [((0.05, 0.55, 0.05), (x, 0.0, z)) for x in (-0.35, 0.35) for z in (-0.2, 0.2)]
    table = boxes(((0.8, 0.05, 0.5), (0.0, 0.3, 0.0)), *legs)
    fat = Mesh(table.vertices + 0.02 * vertex_normals(table.vertices, table.faces), table.faces)
    assert distance(fit_whole_mesh(fat, [view_of(table)], CONFIG).mesh, table) < 0.6 * distance(fat, table)
    stiff = replace(CONFIG, proportions=ProportionFit(thickness_prior=1e9))
    assert distance(fit_whole_mesh(fat, [view_of(table)], stiff).mesh, table) > distance(fat, table)


def test_vertex_normals_by_hand() -> None:
    """Two faces of a box's edge, one of twice the area of the other; a vertex alone."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 1], [5, 5, 5]])
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2], [0, 3, 1]]))
    torch.testing.assert_close(normals[0], torch.tensor([0.0, 1, 2]) / 5**0.5)
    torch.testing.assert_close(normals[2], torch.tensor([0.0, 0, 1]))
    assert normals[4].tolist() == [0, 0, 0]


def test_a_mesh_that_fits_stays(truth: Mesh) -> None:
    fitted = fit_whole_mesh(truth, [view_of(truth)], CONFIG).mesh
    assert distance(fitted, truth) < 0.02


def test_it_stays_at_its_distance_from_the_camera(truth: Mesh) -> None:
    """Too large by a tenth could be too near; the mesh's mean depth says which."""
    forward = CAMERA.world_to_camera[2, :3]
    coarse = Mesh(truth.vertices * 1.1, truth.faces)
    fitted = fit_whole_mesh(coarse, [view_of(truth)], CONFIG).mesh
    assert abs(float((fitted.vertices.mean(0) - truth.vertices.mean(0)) @ forward)) < 0.03
    assert distance(fitted, truth) < 0.75 * distance(coarse, truth)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_a_given_plane_does_not_move(truth: Mesh, normal: tuple[float, float, float]) -> None:
    """Heights above it are scaled by one number, none is shifted, though the object is off by 0.1."""
    n = torch.tensor(normal)
    turn = rotation_from_z(n)
    whole = Mesh(truth.vertices @ turn.T, truth.faces)
    coarse = Mesh(whole.vertices + 0.1 * n, whole.faces)
    as_thick = ProportionFit(thickness_prior=1e9)  # along its normals the mesh would move for another reason
    config = make_config(symmetry_normal=normal, symmetry_offset=0.1)
    config = replace(config, proportions=as_thick)
    fitted = fit_whole_mesh(coarse, [view_of(whole)], config).mesh
    before, after = (mesh.vertices @ n - 0.1 for mesh in (coarse, fitted))
    scale = float((before @ after) / (before @ before))
    torch.testing.assert_close(after, scale * before, atol=1e-3, rtol=0)  # Adam's steps are not zero
    assert float((fitted.vertices - coarse.vertices).norm(dim=1).mean()) > 0.01  # the rest does move


def test_without_a_given_plane_a_symmetric_object_may_move_along_the_normal(truth: Mesh) -> None:
    """A blurred, hence vaguely symmetric, coarse mesh goes half the way at least."""
    noise = 0.04 * torch.randn(truth.vertices.shape, generator=torch.Generator().manual_seed(0))
    coarse = Mesh(truth.vertices + noise + torch.tensor([0.0, 0.0, 0.1]), truth.faces)
    fitted = fit_whole_mesh(coarse, [view_of(truth)], CONFIG).mesh
    assert float(fitted.vertices[:, 2].mean()) < 0.07


def test_no_such_step_in_the_paper(truth: Mesh) -> None:
    coarse = Mesh(truth.vertices * 1.2, truth.faces)
    assert fit_whole_mesh(coarse, [view_of(truth)], RefineConfig.paper()).mesh is coarse


def test_basis_moves_by_hand() -> None:
    """Plane normal +Z: scale about the centroid in the plane and about the plane, shear, translation."""
    coarse = torch.tensor([[0.0, 0.0, 0.4], [2.0, 4.0, 0.8]])
    basis = Basis.of(coarse, torch.tensor([0.0, 0.0, 1.0]))
    zero2, zero3 = torch.zeros(2), torch.zeros(3)
    scaled = basis.move(coarse, torch.tensor([2.0, 3.0, 0.5]).log(), zero2, zero3)
    torch.testing.assert_close(scaled, torch.tensor([[-1.0, -4.0, 0.2], [3.0, 8.0, 0.4]]))
    sheared = basis.move(coarse, zero3, torch.tensor([0.5, 0.1]), zero3)
    torch.testing.assert_close(sheared, torch.tensor([[-1.0, -0.1, 0.4], [3.0, 4.1, 0.8]]))
    shifted = basis.move(coarse, zero3, zero2, torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(shifted, coarse + torch.tensor([1.0, 2.0, 3.0]))
