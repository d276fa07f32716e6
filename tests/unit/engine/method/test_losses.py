"""Each loss against numbers worked out by hand on a tiny mesh or image."""

import math

import pytest
import torch
from torch import Tensor

from refine_engine.kernels import optical_depth, oracle
from refine_engine.method import losses
from refine_engine.method.topology import Topology, neighbour_mean
from refine_engine.values import Mesh

ONE = torch.ones(1, 1, 1)


def depth_of(alpha: list[list[float]]) -> Tensor:
    """Optical depth (1, N, N) of a soft silhouette."""
    return -torch.log1p(-torch.tensor([alpha]))


def test_silhouette_is_the_cross_entropy_of_the_known_pixels() -> None:
    alpha = [[0.25, 0.5], [0.0, 0.9]]
    target = torch.tensor([[[0.0, 1.0], [0.0, 0.0]]])
    known = torch.tensor([[[1.0, 1.0], [1.0, 0.0]]])
    loss = losses.silhouette(depth_of(alpha), target, known)
    assert float(loss) == pytest.approx((-math.log(0.75) - math.log(0.5) + 0) / 3, rel=1e-6)


def test_silhouette_of_a_partly_covered_pixel() -> None:
    loss = losses.silhouette(torch.full((1, 1, 1), 2.0), 0.25 * ONE, ONE)
    assert float(loss) == pytest.approx(0.25 * -math.log(1 - math.exp(-2)) + 0.75 * 2, rel=1e-6)


@pytest.mark.parametrize("depth", [0.0, 1e-30, 1e-8, 1e-4, 1.0, 50.0, 1e4, 1e30])
@pytest.mark.parametrize("target", [0.0, 0.5, 1.0])
def test_silhouette_is_finite_from_empty_to_thickly_covered(depth: float, target: float) -> None:
    depths = torch.full((1, 1, 1), depth, requires_grad=True)
    loss = losses.silhouette(depths, target * ONE, ONE)
    loss.backward()
    assert depths.grad is not None
    assert math.isfinite(float(loss.detach()))
    assert math.isfinite(float(depths.grad))
    if target == 0.0:
        assert float(depths.grad) == 1.0  # however thickly covered: this pixel is still pushed clear
    if target == 1.0 and 1e-4 < depth < 10:
        assert float(depths.grad) == pytest.approx(-1 / math.expm1(depth), rel=1e-5)


def test_silhouette_costs_no_more_than_a_miss() -> None:
    losses_of = [float(losses.silhouette(torch.full((1, 1, 1), s), ONE, ONE)) for s in (0.0, 1e-9, 1e-4)]
    assert losses_of == pytest.approx([-math.log(1e-4)] * 3, rel=1e-4)


def test_pyramid_by_hand() -> None:
    alpha, target = [[0.0, 0.5], [0.0, 0.0]], torch.tensor([[[1.0, 0.0], [0.0, 0.0]]])
    # differences -1, 0.5, 0, 0; one level up their mean, -1/8; two levels, over the object's area 1/4
    loss = losses.silhouette_pyramid(depth_of(alpha), target, torch.ones(1, 2, 2), levels=2)
    assert float(loss) == pytest.approx((1.25 / 4 + 1 / 64) / 2 / 0.25, rel=1e-6)


def test_pyramid_ignores_what_is_not_known() -> None:
    alpha, target = [[0.0, 0.5], [0.0, 0.9]], torch.tensor([[[1.0, 0.0], [0.0, 0.0]]])
    known = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])
    loss = losses.silhouette_pyramid(depth_of(alpha), target, known, levels=2)
    assert float(loss) == pytest.approx((1 / 4 + 1 / 16) / 2 / 0.25, rel=1e-6)


def square(left: float, top: float, side: float) -> tuple[Tensor, Tensor]:
    """Screen (1, 4, 3) and faces of a square."""
    x = torch.tensor([left, left + side, left + side, left])
    y = torch.tensor([top, top, top + side, top + side])
    return torch.stack([x, y, torch.ones(4)], -1)[None], torch.tensor([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("dx", "dy"), [(20, 0), (-20, 0), (0, 20), (0, -20), (20, -20)])
def test_pyramid_pulls_an_outline_that_is_20_pixels_off(dx: int, dy: int) -> None:
    """Where no pixel of the target is within the renderer's reach (2 pixels at this softness)."""
    screen, faces = square(26, 26, 12)
    target = torch.zeros(1, 64, 64)
    target[:, 26 + dy : 38 + dy, 26 + dx : 38 + dx] = 1
    shift = torch.zeros(3, requires_grad=True)
    depth = optical_depth(screen + shift, faces, 64, 4e-4)
    losses.silhouette_pyramid(depth, target, torch.ones_like(target)).backward()
    assert shift.grad is not None
    for pull, distance in zip((-shift.grad).tolist(), (dx, dy, 0), strict=True):
        if distance:
            assert pull * distance > 1e-3 * abs(distance)
        else:
            assert abs(pull) < 1e-4


def test_image_symmetry_by_hand() -> None:
    seen, mirrored = depth_of([[0.5, 0.0], [0.2, 0.9]]), depth_of([[0.25, 0.5], [0.0, 0.3]])
    confidence = torch.tensor([[[1.0, 0.5], [0.25, 0.0]]])
    covered = torch.tensor([[[1.0, 1.0], [1.0, 0.0]]])
    # flipped: 0, 0.5 / 0.9, 0.2; differences 0.25, 0 / 0.9; the last pixel is background
    terms = [1.0 * 0.25**2, 0.1 * math.log(2), 0.25 * 0.9**2 + 0.1 * math.log(4), 0.0]
    loss = oracle.image_symmetry(seen, mirrored, confidence, covered, 0.1)
    assert float(loss) == pytest.approx(sum(terms) / 4, rel=1e-5)


def test_vertex_symmetry_by_hand() -> None:
    vertices = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.5]])
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
    confidence = torch.tensor([1.0, 0.5])
    loss = losses.vertex_symmetry(vertices, torch.tensor([1, 0]), mirror, confidence, 0.1)
    assert float(loss) == pytest.approx((0.25 + 0.5 * 0.25 + 0.1 * math.log(2)) / 2, rel=1e-6)


def test_confidence_zero_costs_a_finite_amount() -> None:
    cost = oracle.confidence_cost(torch.tensor([1.0, math.exp(-1), 0.0]), 0.5)
    assert cost.tolist() == pytest.approx([0.0, 0.5, 0.5 * math.log(1e6)], rel=1e-5)


def test_displacement_by_hand() -> None:
    assert float(losses.displacement(torch.tensor([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]))) == pytest.approx(1.0)


def hinge(degrees: float) -> Tensor:
    """Edge 0-1 along x, vertex 2 on one side of it, vertex 3 on the other, folded up out of the plane."""
    a = math.radians(degrees)
    return torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, -1, 0], [0.3, 2 * math.cos(a), 2 * math.sin(a)]])


@pytest.mark.parametrize("faces", [[[0, 1, 3], [1, 0, 2]], [[0, 1, 3], [0, 1, 2]]], ids=["wound", "inverted"])
@pytest.mark.parametrize(("degrees", "expected"), [(0, 0.0), (60, 0.5), (90, 1.0), (120, 1.5), (180, 2.0)])
def test_normal_consistency_by_hand(faces: list[list[int]], degrees: float, expected: float) -> None:
    loss = losses.normal_consistency(hinge(degrees), Topology.of(torch.tensor(faces), 4))
    assert float(loss) == pytest.approx(expected, abs=1e-5)


def test_normal_consistency_is_the_mean_over_hinges() -> None:
    """The middle triangle of three; one neighbour is in its plane, the other stands upright."""
    vertices = torch.cat([hinge(90), torch.tensor([[1.0, -1.0, 0.0]])])
    topology = Topology.of(torch.tensor([[0, 1, 3], [1, 0, 2], [1, 2, 4]]), 5)
    assert float(losses.normal_consistency(vertices, topology)) == pytest.approx((1.0 + 0.0) / 2, abs=1e-6)


def test_normal_consistency_without_neighbours_is_zero_and_differentiable() -> None:
    vertices = hinge(0).requires_grad_()
    loss = losses.normal_consistency(vertices, Topology.of(torch.tensor([[0, 1, 2]]), 4))
    loss.backward()
    assert float(loss.detach()) == 0.0


def test_normal_consistency_does_not_shake_a_mesh_that_has_flat_faces() -> None:
    """A T-junction, closed by the face 0-4-1, which has no area.

    3 .           faces 0-1-3 above the edge, 0-2-4 and 4-2-1 below it
    0-4-1
    . 2 .
    """
    vertices = torch.cat([hinge(30), torch.tensor([[0.5, 0.0, 0.0]])]).requires_grad_()
    topology = Topology.of(torch.tensor([[0, 1, 3], [0, 2, 4], [4, 2, 1], [0, 4, 1]]), 5)
    losses.normal_consistency(vertices, topology).backward()
    assert vertices.grad is not None
    assert float(vertices.grad.abs().max()) < 100


def test_laplacian_by_hand() -> None:
    vertices = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    topology = Topology.of(torch.tensor([[0, 1, 2]]), 3)
    loss = losses.laplacian(vertices, neighbour_mean(vertices, topology))
    assert float(loss) == pytest.approx((math.sqrt(2) + 2 * math.sqrt(5)) / 3, rel=1e-6)


def test_the_place_of_the_mesh_does_not_matter_to_what_smooths() -> None:
    vertices, moved = hinge(60), hinge(60) + torch.tensor([3.0, -2.0, 5.0])
    topology = Topology.of(torch.tensor([[0, 1, 3], [1, 0, 2]]), 4)
    for measured in (
        [losses.normal_consistency(v, topology) for v in (vertices, moved)],
        [losses.laplacian(v, neighbour_mean(v, topology)) for v in (vertices, moved)],
    ):
        assert float(measured[1]) == pytest.approx(float(measured[0]), rel=1e-5)


@pytest.mark.parametrize("size", [0.01, 1.0, 100.0])
def test_a_sliver_counts_less_whatever_its_size(size: float) -> None:
    """Face 0-1-3 is upright, 1e-3 high and 1 long: a tenth of the height at which it would count in full."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, -1, 0], [0.0, 0.0, 1e-3]])
    topology = Topology.of(torch.tensor([[0, 1, 3], [1, 0, 2]]), 4)
    flat, upright = vertices.clone(), vertices
    flat[3] = torch.tensor([0.0, 1e-3, 0.0])
    assert float(losses.normal_consistency(size * upright, topology)) == pytest.approx(1.0)
    assert float(losses.normal_consistency(size * flat, topology)) == pytest.approx(0.9, rel=1e-3)


def test_laplacian_of_a_vertex_among_its_neighbours_is_nearly_zero_with_a_gradient() -> None:
    vertices = torch.zeros(3, 3, requires_grad=True)
    loss = losses.laplacian(vertices, torch.zeros(3, 3))
    loss.backward()
    assert float(loss.detach()) == pytest.approx(1e-6)
    assert vertices.grad is not None
    assert torch.equal(vertices.grad, torch.zeros(3, 3))


def test_gradients() -> None:
    random = torch.Generator().manual_seed(5)

    def positive(*shape: int) -> Tensor:
        return (0.1 + torch.rand(*shape, generator=random, dtype=torch.float64)).requires_grad_()

    target, known = (torch.rand(1, 4, 4, generator=random, dtype=torch.float64) for _ in range(2))
    depth, other, sigma = positive(1, 4, 4), positive(1, 4, 4), positive(1, 4, 4)
    vertices, confidence = positive(6, 3), positive(6)
    faces = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4], [4, 0, 5]])
    topology, nearest = Topology.of(faces, 6), torch.tensor([1, 3, 5, 0, 2, 4])
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    check = torch.autograd.gradcheck
    assert check(lambda s: losses.silhouette(s, target, known), depth)
    assert check(lambda s: losses.silhouette_pyramid(s, target, known, 3), depth)
    assert check(lambda s, m, c: oracle.image_symmetry(s, m, c, known, 0.1), (depth, other, sigma))
    assert check(lambda v, c: losses.vertex_symmetry(v, nearest, mirror, c, 0.1), (vertices, confidence))
    assert check(losses.displacement, vertices)
    assert check(lambda v: losses.normal_consistency(v, topology), vertices)
    assert check(lambda v: losses.laplacian(v, neighbour_mean(v, topology)), vertices)


@pytest.mark.parametrize(
    ("before", "after"), [(0, 40), (30, 70), (30, -30), (0, 180), (-90, -90), (170, -170)]
)
def test_fold_change_of_a_hinge(before: float, after: float) -> None:
    """1 - cos of the difference, also across 180 degrees."""
    topology = Topology.of(torch.tensor([[0, 1, 2], [1, 0, 3]]), 4)
    folds = losses.fold_angles(hinge(before), topology)
    change = losses.fold_change(hinge(after), topology, folds)
    assert float(change) == pytest.approx(1 - math.cos(math.radians(after - before)), abs=1e-5)


def test_fold_change_does_not_see_rigid_motion(ball: Mesh) -> None:
    topology = Topology.of(ball.faces, len(ball.vertices))
    folds = losses.fold_angles(ball.vertices, topology)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    turn = turn * torch.linalg.det(turn)  # a rotation
    for same in (ball.vertices, ball.vertices @ turn.T + torch.tensor([3.0, -1.0, 2.0]), 5 * ball.vertices):
        assert float(losses.fold_change(same, topology, folds)) == pytest.approx(0.0, abs=1e-5)
    bent = ball.vertices * torch.tensor([1.0, 1.0, 0.3])
    assert float(losses.fold_change(bent, topology, folds)) > 0.005
    assert float(losses.normal_consistency(ball.vertices, topology)) > 0.005  # which is not zero for a ball


def test_fold_change_without_hinges() -> None:
    topology = Topology.of(torch.tensor([[0, 1, 2]]), 3)
    vertices = hinge(0)[:3]
    folds = losses.fold_angles(vertices, topology)
    assert float(losses.fold_change(vertices, topology, folds)) == 0.0
