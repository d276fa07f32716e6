"""The CUDA back end against the specification, its kernels run on the CPU (conftest.py)."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from refine_engine.kernels import cpu, cuda, interpolate, nvrtc, oracle

SIDE = 40
SOFTNESS = 3e-3  # reaches 3.3 pixels at this size


def random_mesh(seed: int, vertices: int = 24, faces: int = 40, views: int = 2) -> tuple[Tensor, Tensor]:
    """Triangles all over the image and beyond its borders, some behind the camera."""
    generator = torch.Generator().manual_seed(seed)
    screen = torch.rand(views, vertices, 3, generator=generator)
    screen[..., :2] = screen[..., :2] * 1.6 * SIDE - 0.3 * SIDE
    screen[..., 2] = screen[..., 2] * 2 + 0.5
    screen[:, 0, 2] = -0.3  # behind
    screen[:, 1, 2] = 0.5 * oracle.NEAR
    corners = torch.stack([torch.randperm(vertices, generator=generator)[:3] for _ in range(faces)])
    return screen, corners


def awkward_faces() -> tuple[Tensor, Tensor]:
    """Faces that renderers get wrong, one of each kind, and two plain ones."""
    points: dict[str, list[tuple[float, float]]] = {
        "edge-on": [(5, 5), (15, 5), (30, 5)],
        "point": [(20.5, 20.5)] * 3,
        "two equal corners": [(8, 30), (8, 30), (25, 33)],
        "off the screen": [(-90, -90), (-80, -90), (-80, -80)],
        "just off the screen": [(-2, 10), (-2, 20), (-9, 15)],
        "beyond int": [(-4e9, 22), (4e9, 22), (0, 22.5)],
        "plain": [(10, 10), (30, 12), (18, 28)],
        "plain, the other way round": [(10, 10), (18, 28), (30, 12)],
        "not finite": [(10, float("nan")), (20, 20), (10, 20)],
        "infinite": [(10, float("inf")), (20, 20), (10, 20)],
        "behind": [(10, 12), (20, 20), (10, 20)],
    }
    depth = [-1.0 if name == "behind" else 1.5 for name in points]
    screen = torch.tensor([[(x, y, z) for x, y in p] for p, z in zip(points.values(), depth, strict=True)])
    return screen.reshape(1, -1, 3), torch.arange(3 * len(points)).reshape(-1, 3)


def with_gradient(render: Any, screen: Tensor, faces: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    points = screen.clone().requires_grad_()
    depth = render(points, faces, SIDE, SOFTNESS)
    (depth * weight).sum().backward()
    assert points.grad is not None
    return depth.detach(), points.grad


def relative(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm() / b.norm())


@pytest.mark.parametrize("seed", range(3))
def test_optical_depth_and_gradient_match_the_specification(emulator: Any, seed: int) -> None:
    screen, faces = random_mesh(seed)
    weight = torch.randn(len(screen), SIDE, SIDE, generator=torch.Generator().manual_seed(seed))
    weight[:, 10:20] = 0  # pixels without a gradient are skipped
    depth, grad = with_gradient(cuda.optical_depth, screen, faces, weight)
    expected, expected_grad = with_gradient(oracle.optical_depth, screen, faces, weight)
    assert float(expected.max()) > 5
    assert float((expected == 0).float().mean()) < 0.9
    torch.testing.assert_close(depth, expected, rtol=1e-5, atol=1e-5)
    assert relative(grad, expected_grad) < 1e-5
    torch.testing.assert_close(grad, expected_grad, rtol=1e-3, atol=1e-4 * float(expected_grad.abs().max()))
    assert not grad[..., 2].any()


def test_awkward_faces_match_the_specification(emulator: Any) -> None:
    screen, faces = awkward_faces()
    depth = cuda.optical_depth(screen, faces, SIDE, SOFTNESS)
    torch.testing.assert_close(
        depth, oracle.optical_depth(screen, faces, SIDE, SOFTNESS), rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("face", range(11))
def test_awkward_face_moves_as_the_specification_says(emulator: Any, face: int) -> None:
    """Where two edges coincide the split between their corners is a matter of taste, the sum is not."""
    screen, faces = awkward_faces()
    weight = torch.randn(1, SIDE, SIDE, generator=torch.Generator().manual_seed(face))
    _, grad = with_gradient(cuda.optical_depth, screen, faces[face : face + 1], weight)
    _, expected = with_gradient(oracle.optical_depth, screen, faces[face : face + 1], weight)
    torch.testing.assert_close(grad.sum(1), expected.sum(1), rtol=1e-3, atol=1e-3)


def test_gradient_is_the_slope_of_the_value(emulator: Any) -> None:
    screen, faces = random_mesh(7, vertices=9, faces=6, views=1)
    weight = torch.rand(1, SIDE, SIDE, generator=torch.Generator().manual_seed(1))
    _, grad = with_gradient(cuda.optical_depth, screen, faces, weight)
    step = 0.02  # pixels
    for vertex, axis in [(2, 0), (3, 1), (4, 0), (5, 1), (6, 0)]:
        ends = []
        for sign in (1, -1):
            moved = screen.clone()
            moved[0, vertex, axis] += sign * step
            ends.append(float((cuda.optical_depth(moved, faces, SIDE, SOFTNESS).double() * weight).sum()))
        slope = (ends[0] - ends[1]) / (2 * step)
        assert slope == pytest.approx(float(grad[0, vertex, axis]), rel=0.03, abs=0.3)


def test_every_bit_is_the_same_in_any_order_of_blocks(emulator: Any) -> None:
    screen, faces = random_mesh(5)
    weight = torch.randn(len(screen), SIDE, SIDE, generator=torch.Generator().manual_seed(2))
    runs = []
    for emulator.backwards in (False, True):
        depth, grad = with_gradient(cuda.optical_depth, screen, faces, weight)
        fragments = cuda.rasterize(screen, faces, (SIDE, SIDE))
        _, *slopes = symmetry(cuda.image_symmetry, depth, depth.flip(0), fragments, faces)
        nearest = cuda.nearest_point(screen[0], screen[1])
        runs.append([depth, grad, fragments.face, fragments.barycentric, nearest, *slopes])
    for one, other in zip(*runs, strict=True):
        assert torch.equal(one, other)


def slivers_near_the_camera(height: float, count: int = 60) -> Tensor:
    """(B, 3, 3), a face for each view, up to thousands of pixels long; `height` over its length."""
    generator = torch.Generator().manual_seed(11)
    depth = oracle.NEAR * 1.01 + 0.3 * torch.rand(count, 3, 1, generator=generator).square()
    across = 0.6 * torch.rand(count, 3, 2, generator=generator) - 0.3
    corners = across * SIDE / depth + SIDE / 2
    length = corners[:, 1] - corners[:, 0]
    middle = corners[:, 0] + torch.rand(count, 1, generator=generator) * length
    corners[:, 2] = middle + height * torch.stack([-length[:, 1], length[:, 0]], 1)
    return torch.cat([corners, depth], 2)


@pytest.mark.parametrize("back_end", [cpu, cuda])
@pytest.mark.parametrize("height", [1e-2, 1e-4, 1e-6, 1e-7, 0.0])
def test_slivers_near_the_camera_match_the_specification(emulator: Any, back_end: Any, height: float) -> None:
    """Whether a pixel is inside one is for rounding to say, but not what that comes to."""
    screen, faces = slivers_near_the_camera(height), torch.tensor([[0, 1, 2]])
    depth = back_end.optical_depth(screen, faces, SIDE, SOFTNESS)
    expected = oracle.optical_depth(screen.double(), faces, SIDE, SOFTNESS)
    assert int((expected > 0).sum()) > 2000
    torch.testing.assert_close(depth.double(), expected, rtol=0, atol=1e-3)
    seen = back_end.rasterize(screen, faces, (SIDE, SIDE)).face >= 0
    differ = seen != (oracle.rasterize(screen.double(), faces, (SIDE, SIDE)).face >= 0)
    assert int(differ.sum()) <= 2  # centres on an edge


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("size", [(SIDE, SIDE), (24, 56)])
def test_rasterize_matches_the_specification(
    emulator: Any, size: tuple[int, int], orthographic: bool
) -> None:
    screen, faces = random_mesh(3)
    seen = cuda.rasterize(screen, faces, size, orthographic)
    expected = oracle.rasterize(screen, faces, size, orthographic)
    assert torch.equal(seen.face, expected.face)
    assert len(expected.face.unique()) > 10
    torch.testing.assert_close(seen.barycentric, expected.barycentric, rtol=1e-4, atol=1e-5)


def test_rasterize_leaves_out_what_the_specification_leaves_out(emulator: Any) -> None:
    screen, faces = awkward_faces()
    seen, expected = (
        cuda.rasterize(screen, faces, (SIDE, SIDE)),
        oracle.rasterize(screen, faces, (SIDE, SIDE)),
    )
    plain = {-1, 6, 7}  # these two lie on one another: rounding says which is seen
    assert set(expected.face.unique().tolist()) <= plain
    assert set(seen.face.unique().tolist()) <= plain
    assert torch.equal(seen.face >= 0, expected.face >= 0)


def symmetry(
    loss: Any, seen: Tensor, mirrored: Tensor, fragments: Any, faces: Tensor, cost: float = 5e-4
) -> list[Tensor]:
    confidence = torch.rand(24, generator=torch.Generator().manual_seed(4)).requires_grad_()
    seen, mirrored = seen.clone().requires_grad_(), mirrored.clone().requires_grad_()
    value = loss(seen, mirrored, fragments, faces, confidence, cost)
    (80 * value).backward()
    gradients = [t.grad for t in (seen, mirrored, confidence) if t.grad is not None]
    assert len(gradients) == 3
    return [value.detach(), *gradients]


def plain_symmetry(
    seen: Tensor, mirrored: Tensor, fragments: Any, faces: Tensor, confidence: Tensor, cost: float
) -> Tensor:
    sigma, covered = interpolate(fragments, faces, confidence), (fragments.face >= 0).float()
    return oracle.image_symmetry(seen, mirrored, sigma, covered, cost)


@pytest.mark.parametrize("cost", [5e-4, 1.0])
def test_image_symmetry_matches_the_plain_loss(emulator: Any, cost: float) -> None:
    screen, faces = random_mesh(6)
    depth = oracle.optical_depth(screen, faces, SIDE, SOFTNESS)
    mirrored = oracle.optical_depth(screen + 1, faces, SIDE, SOFTNESS)
    fragments = oracle.rasterize(screen + 1, faces, (SIDE, SIDE))
    result = symmetry(cuda.image_symmetry, depth, mirrored, fragments, faces, cost)
    expected = symmetry(plain_symmetry, depth, mirrored, fragments, faces, cost)
    for one, other in zip(result, expected, strict=True):
        assert relative(one, other) < 1e-5


def test_an_asymmetric_place_costs_no_difference(emulator: Any) -> None:
    """Where sigma is 0 the difference counts nothing at all, also below the least that its logarithm sees."""
    screen, faces = random_mesh(6)
    fragments = oracle.rasterize(screen, faces, (SIDE, SIDE))
    seen = torch.rand(2, SIDE, SIDE, generator=torch.Generator().manual_seed(8)).requires_grad_()
    cuda.image_symmetry(seen, torch.zeros_like(seen), fragments, faces, torch.zeros(24), 5e-4).backward()
    assert seen.grad is not None
    assert not seen.grad.any()


@pytest.mark.parametrize("count", [1, 5, 300, 1100])
def test_nearest_point_matches_all_distances(emulator: Any, count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    points, queries = torch.rand(2, count, 3, generator=generator)
    expected = torch.cdist(queries.double(), points.double()).argmin(1)
    assert torch.equal(cuda.nearest_point(points, queries), expected)


def test_nearest_point_takes_the_lower_of_two_at_the_same_place(emulator: Any) -> None:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    expected = torch.arange(400)
    points[300:], expected[300:] = points[:100], torch.arange(100)  # in another run of candidates
    points[130:140], expected[130:140] = points[110:120], torch.arange(110, 120)  # in the same
    assert torch.equal(cuda.nearest_point(points, points), expected)


def test_every_kernel_is_run_by_these_functions(emulator: Any) -> None:
    screen, faces = random_mesh(1)
    depth, _ = with_gradient(cuda.optical_depth, screen, faces, torch.ones(2, SIDE, SIDE))
    symmetry(cuda.image_symmetry, depth, depth, cuda.rasterize(screen, faces, (SIDE, SIDE)), faces)
    cuda.nearest_point(screen[0], screen[1])
    assert emulator.launched == set(emulator.kernels)


def test_grids_cover_everything() -> None:
    for count in (1, 127, 128, 129, 3000, 200_000):
        x, y = cuda.per_face(count, 13)
        assert y == 13
        assert 0 <= x * nvrtc.BLOCK // nvrtc.LANES - count < nvrtc.BLOCK // nvrtc.LANES
        x, y = cuda.per_item(count, 13)
        assert y == 13
        assert 0 <= x * nvrtc.BLOCK - count < nvrtc.BLOCK
        x, y = cuda.per_query(count)
        assert 0 <= x * nvrtc.BLOCK * nvrtc.QUERIES - count < nvrtc.BLOCK * nvrtc.QUERIES
        assert 0 <= y * cuda.RUN - count < cuda.RUN
        assert y <= 65535  # the card's limit


def test_products_keep_float32() -> None:
    flags: list[Any] = [torch.backends.cudnn, torch.backends.cuda.matmul]
    before = [flag.allow_tf32 for flag in flags]
    try:
        for flag in flags:
            flag.allow_tf32 = True
        cuda.keep_float32()
        assert [flag.allow_tf32 for flag in flags] == [False, False]
    finally:
        for flag, value in zip(flags, before, strict=True):
            flag.allow_tf32 = value


def test_corner_table_lists_each_corner_once_at_its_vertex() -> None:
    faces = torch.tensor([[0, 1, 2], [2, 1, 3], [5, 2, 0]])
    table = cuda.CornerTable.of(faces, 7)
    met = [table.incident[a:b].tolist() for a, b in zip(table.offsets, table.offsets[1:], strict=False)]
    assert met == [[0, 8], [1, 4], [2, 3, 7], [5], [], [6], []]


def test_corner_table_is_dropped_with_its_mesh() -> None:
    faces = torch.tensor([[0, 1, 2]])
    table = cuda._table(faces, 3)
    assert cuda._table(faces, 3) is table
    assert len(cuda._table(faces, 4).offsets) == 5
    before = len(cuda._tables)
    del faces
    assert len(cuda._tables) == before - 1
