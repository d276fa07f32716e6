"""Projection by hand, the rig's formula, and cameras behind the mirror."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from refine_engine.cameras.project import project, reflect, stack
from refine_engine.kernels import optical_depth
from refine_engine.method.symmetry import mirror_matrix
from refine_engine.values import Camera

CPU = torch.device("cpu")
NORMALS = [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.3, -0.5, 0.8)]


def test_projection_by_hand() -> None:
    """A camera at the origin that looks along +Z: x / z * f + c."""
    matrix, intrinsics = torch.eye(4)[None], torch.tensor([[100.0, 50.0, 32.0, 24.0]])
    points = torch.tensor([[0.0, 0.0, 2.0], [0.5, 1.0, 2.0], [1.0, 1.0, -1.0], [0.002, 0.0, 0.0]])
    expected = torch.tensor([[32.0, 24, 2], [57, 49, 2], [10032, 5024, -1], [52, 24, 0]])
    torch.testing.assert_close(project(points, matrix, intrinsics)[0], expected)
    flat = project(points, matrix, intrinsics, orthographic=True)[0]
    torch.testing.assert_close(flat, torch.tensor([[32.0, 24, 2], [82, 74, 2], [132, 74, -1], [32.2, 24, 0]]))


@pytest.mark.parametrize("azimuth", [0, 30, 90, 200, -45])
@pytest.mark.parametrize("elevation", [-90, -45, 0, 28, 89])
def test_look_at_stands_where_the_formula_says_and_looks_at_the_origin(azimuth: int, elevation: int) -> None:
    camera = Camera.look_at(azimuth, elevation, 1.9, 60, 64, 48)
    a, e = math.radians(azimuth), math.radians(elevation)
    expected = 1.9 * torch.tensor([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    torch.testing.assert_close(-rotation.T @ translation, expected, atol=1e-6, rtol=0)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-6)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    centre, above = project(points, *stack([camera], CPU))[0]
    torch.testing.assert_close(centre, torch.tensor([32.0, 24.0, 1.9]), atol=1e-5, rtol=0)
    assert float(above[0]) == pytest.approx(32, abs=1e-4)
    if abs(elevation) < 89:
        assert above[1] < centre[1]  # +Y is up, and pixels count downwards


def test_field_of_view_is_that_of_the_height() -> None:
    camera = Camera.look_at(0, 0, 2.0, 60, 64, 48)
    top = torch.tensor([[0.0, 2 * math.tan(math.radians(30)), 0.0]])
    assert project(top, *stack([camera], CPU))[0, 0, 1] == pytest.approx(0.0, abs=1e-4)


@pytest.fixture
def lopsided() -> tuple[Tensor, Tensor]:
    """A mesh without any symmetry: vertices (12, 3), faces."""
    random = torch.Generator().manual_seed(6)
    vertices = torch.rand(12, 3, generator=random) * torch.tensor([0.8, 0.5, 0.3]) - 0.2
    return vertices, torch.randint(0, 12, (10, 3), generator=random)


@pytest.mark.parametrize("normal", NORMALS)
def test_reflected_camera_sees_the_flipped_mirror_image(
    normal: tuple[float, float, float], lopsided: tuple[Tensor, Tensor]
) -> None:
    vertices, faces = lopsided
    n = F.normalize(torch.tensor(normal), dim=0)
    matrix, intrinsics = stack([Camera.look_at(35, 20, 1.9, 60, 48, 48)], CPU)
    here = project(vertices @ mirror_matrix(n), matrix, intrinsics)
    there = project(vertices, reflect(matrix, n), intrinsics)
    torch.testing.assert_close(there[..., 0], 48 - here[..., 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(there[..., 1:], here[..., 1:], atol=1e-4, rtol=0)
    pictures = [optical_depth(screen, faces, 48, 1e-3) for screen in (here, there)]
    assert pictures[0].max() > 1
    torch.testing.assert_close(pictures[1], pictures[0].flip(-1), atol=2e-2, rtol=1e-2)
    assert not torch.allclose(
        pictures[1], optical_depth(project(vertices, matrix, intrinsics), faces, 48, 1e-3)
    )


def test_reflected_camera_is_a_camera() -> None:
    """A rotation and a position, not a mirror image of one."""
    matrix, _ = stack([Camera.look_at(35, 20, 1.9, 60, 48, 48)], CPU)
    n = F.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
    there = reflect(matrix, n)[0]
    assert Camera(there, 40, 40, 24, 24, 48, 48).world_to_camera is there
    place, expected = (
        -there[:3, :3].T @ there[:3, 3],
        -matrix[0, :3, :3].T @ matrix[0, :3, 3] @ mirror_matrix(n),
    )
    torch.testing.assert_close(place, expected, atol=1e-5, rtol=0)
