"""Mirror planes, and the nearest vertex on the other side."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from refine_engine.method.symmetry import (
    best_confidence,
    least_mirrored_offset,
    mirror_error,
    mirror_matrix,
    nearest_mirrored,
    rotation_from_z,
    surface_confidence,
    surface_points,
)
from refine_engine.values import Mesh, MirrorPlane

NORMALS = [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.3, -0.5, 0.8), (0.1, 0.0, -0.9)]


def unit(normal: tuple[float, float, float]) -> Tensor:
    return F.normalize(torch.tensor(normal, dtype=torch.float32), dim=0)


def test_mirror_matrix_by_hand() -> None:
    assert torch.equal(mirror_matrix(unit((0, 1, 0))), torch.diag(torch.tensor([1.0, -1.0, 1.0])))
    n = torch.tensor([0.6, 0.0, 0.8])
    expected = torch.tensor([[0.28, 0, -0.96], [0, 1, 0], [-0.96, 0, -0.28]])
    torch.testing.assert_close(mirror_matrix(n), expected)


@pytest.mark.parametrize("normal", NORMALS)
def test_rotation_from_z(normal: tuple[float, float, float]) -> None:
    n = unit(normal)
    rotation = rotation_from_z(n)
    torch.testing.assert_close(rotation @ torch.tensor([0.0, 0.0, 1.0]), n)
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-5)
    # the smallest rotation: its axis is across both, its angle is theirs
    axis = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), n)
    torch.testing.assert_close(rotation @ axis, axis, atol=1e-5, rtol=0)
    assert float(rotation.trace()) == pytest.approx(1 + 2 * float(n[2]), abs=1e-5)


def test_rotation_from_z_at_the_poles() -> None:
    assert torch.equal(rotation_from_z(torch.tensor([0.0, 0.0, 1.0])), torch.eye(3))
    assert torch.equal(rotation_from_z(torch.tensor([0.0, 0.0, -1.0])), torch.eye(3))


def test_nearest_mirrored_by_hand() -> None:
    vertices = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, -1.0], [0.0, 5.0, 0.0], [0.0, 0.0, -3.0]])
    assert nearest_mirrored(vertices, mirror_matrix(unit((0, 0, 1)))).tolist() == [1, 0, 2, 0]


@pytest.mark.parametrize("count", [1, 500, 4000])
@pytest.mark.parametrize("normal", NORMALS)
def test_nearest_mirrored_is_the_nearest(count: int, normal: tuple[float, float, float]) -> None:
    vertices = torch.rand(count, 3, generator=torch.Generator().manual_seed(8)) - 0.3
    mirror = mirror_matrix(unit(normal))
    nearest = nearest_mirrored(vertices, mirror)
    assert nearest.dtype == torch.int64
    mirrored = vertices @ mirror
    for v in range(0, count, max(1, count // 200)):
        least = (vertices - mirrored[v]).norm(dim=1).min()
        assert float((vertices[nearest[v]] - mirrored[v]).norm()) == pytest.approx(float(least), abs=1e-4)


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("place", [-40.0, 0.0, 0.7])
def test_offset_of_a_symmetric_mesh_that_was_moved(
    ball: Mesh, normal: tuple[float, float, float], place: float
) -> None:
    """Moved across the plane, which matters, and along it, which does not."""
    n = unit(normal)
    along = rotation_from_z(n)[:, 0]
    vertices = 3 * ball.vertices @ rotation_from_z(n).T + place * n + 17 * along
    assert least_mirrored_offset(Mesh(vertices, ball.faces), n) == pytest.approx(place, abs=0.03)


def test_offset_follows_the_surface_and_not_the_bounding_box(ball: Mesh) -> None:
    """A long thin spike on one side moves the box, not the plane."""
    spike = torch.tensor([[0.0, 0.0, 0.4], [0.02, 0.0, 0.4], [0.0, 0.0, 1.2]])
    vertices = torch.cat([ball.vertices, spike])
    mesh = Mesh(vertices, torch.cat([ball.faces, torch.tensor([[162, 163, 164]])]))
    offset = least_mirrored_offset(mesh, unit((0, 0, 1)))
    assert offset == pytest.approx(0.0, abs=0.03)  # the middle of the box is 0.35
    error = mirror_error(mesh, unit((0, 0, 1)))
    assert error(offset) <= min(error(offset + step / 100) for step in range(-30, 31))


def test_surface_points_are_spread_by_area_and_the_same_each_time() -> None:
    """Two squares of side 1 and 3, in the planes z = 0 and z = 1."""
    one = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = torch.cat([one, 3 * one + torch.tensor([0.0, 0.0, 1.0])])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    mesh = Mesh(vertices, faces)
    points = surface_points(mesh, 1000)
    assert torch.equal(points, surface_points(mesh, 1000))
    assert int((points[:, 2] == 0).sum()) == pytest.approx(100, abs=1)
    on_large = points[points[:, 2] == 1]
    torch.testing.assert_close(on_large[:, :2].mean(0), torch.tensor([1.5, 1.5]).double(), atol=0.05, rtol=0)
    assert float(on_large[:, :2].amin()) >= 0
    assert float(on_large[:, :2].amax()) <= 3


def test_best_confidence_by_hand() -> None:
    """1 up to d^2 = cost, then cost over d^2."""
    distance2 = torch.tensor([0.0, 0.0004, 0.0005, 0.001, 0.05])
    torch.testing.assert_close(best_confidence(distance2, 0.0005), torch.tensor([1.0, 1.0, 1.0, 0.5, 0.01]))


def test_best_confidence_minimises_its_loss() -> None:
    sigma = torch.linspace(0.001, 1, 1000)
    for distance2 in (0.0, 0.0003, 0.002, 0.1):
        loss = sigma * distance2 - 0.0005 * sigma.log()
        best = float(best_confidence(torch.tensor(distance2), 0.0005))
        assert best == pytest.approx(float(sigma[loss.argmin()]), abs=1e-3)


PLANE = MirrorPlane(torch.tensor([0.0, 0.0, 1.0]), 0.0, None)


def test_a_symmetric_object_is_confident_whatever_its_triangles(ball: Mesh) -> None:
    """Turned about a slanted axis a ball is the same surface, but no vertex lies across from another."""
    turned = Mesh(ball.vertices @ rotation_from_z(unit((0.3, 0.2, 0.9))).T, ball.faces)
    assert float(surface_confidence(turned, PLANE, 1.0, 0.0005).min()) > 0.9
    mirror = mirror_matrix(PLANE.normal)
    apart = turned.vertices @ mirror - turned.vertices[nearest_mirrored(turned.vertices, mirror)]
    assert float(best_confidence(apart.square().sum(1), 0.0005).mean()) < 0.5


def test_an_added_arm_is_not_symmetric(ball: Mesh) -> None:
    """Of a box from z = 0.4 to 1 on one side, the far end is 0.5 from its mirror image's nearest surface."""
    arm = torch.tensor([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (0.4, 1.0)])
    quads = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]) + 162
    mesh = Mesh(torch.cat([ball.vertices, arm]), torch.cat([ball.faces, faces]))
    confidence = surface_confidence(mesh, PLANE, 1.0, 0.0005)
    assert float(confidence[:162].median()) > 0.99
    end = confidence[162:][arm[:, 2] == 1.0]
    torch.testing.assert_close(end, torch.full((4,), (0.0015 / 0.5**2) ** 2), rtol=0.1, atol=0)
    twice = surface_confidence(mesh, PLANE, 2.0, 0.0005)[162:][arm[:, 2] == 1.0]
    torch.testing.assert_close(twice, 16 * end, rtol=0.01, atol=0)  # distances are in units of the scale
