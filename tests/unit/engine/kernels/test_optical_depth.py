"""The CPU back end against the oracle, the oracle against finite differences, one triangle by hand."""

import math
from collections.abc import Callable
from typing import Protocol

import pytest
import torch
from torch import Tensor

from refine_engine.kernels import cpu, optical_depth, oracle


class Scene(Protocol):
    @property
    def screen(self) -> Tensor: ...
    @property
    def faces(self) -> Tensor: ...
    @property
    def ties(self) -> bool: ...


def depth_and_gradient(
    render: Callable[[Tensor, Tensor, int, float], Tensor],
    scene: Scene,
    side: int,
    softness: float,
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """S, and dL/dscreen for a random dL/dS that is zero at every third pixel; both float64."""
    screen = scene.screen.to(dtype, copy=True).requires_grad_()
    depth = render(screen, scene.faces, side, softness)
    upstream = torch.randn(depth.shape, generator=torch.Generator().manual_seed(7))
    upstream.view(-1)[::3] = 0
    depth.backward(upstream.to(dtype))
    assert screen.grad is not None
    return depth.detach().double(), screen.grad.double()


def affine(gradient: Tensor, screen: Tensor) -> Tensor:
    """dL with respect to an affine motion of each three vertices in a row: (B, V, 3) -> (B, V / 3, 2, 3).

    Where two sides of a face are equally near, the derivative by a corner is not defined; this one is.
    """
    position = torch.cat([screen[..., :2].double(), torch.ones_like(screen[..., :1]).double()], -1)
    by_triple = gradient[..., :2].unflatten(1, (-1, 3)), position.unflatten(1, (-1, 3))
    return torch.einsum("bpvi,bpvj->bpij", *by_triple)


def relative_error(value: Tensor, expected: Tensor) -> float:
    return float((value - expected).abs().max() / expected.abs().max())


@pytest.mark.parametrize(("side", "softness"), [(16, 3e-3), (23, 6e-4), (40, 1e-4), (47, 3e-5)])
def test_cpu_agrees_with_the_oracle(make_scene: Callable[[int], Scene], side: int, softness: float) -> None:
    scene = make_scene(side)
    expected, expected_gradient = depth_and_gradient(
        oracle.optical_depth, scene, side, softness, torch.float64
    )
    depth, gradient = depth_and_gradient(cpu.optical_depth, scene, side, softness, torch.float32)
    assert expected.max() > 0.5
    assert float(((depth - expected).abs() / expected.clamp_min(1)).max()) < 1e-4
    assert relative_error(affine(gradient, scene.screen), affine(expected_gradient, scene.screen)) < 1e-3
    if not scene.ties:
        assert relative_error(gradient, expected_gradient) < 1e-3


def test_a_face_in_line_with_pixel_centres_has_no_inside() -> None:
    """Corners on the diagonal: rounding must not make its extension, where all sides are zero, an inside."""
    side, softness = 32, 1e-3
    for start in torch.linspace(10.1, 13.9, 37).tolist():
        x = torch.tensor([start, start + 3.3, start + 1.7])
        screen = torch.stack([x, x, torch.ones(3)], -1)[None]
        faces = torch.tensor([[0, 1, 2]])
        depth = cpu.optical_depth(screen, faces, side, softness)
        expected = oracle.optical_depth(screen.double(), faces, side, softness)
        torch.testing.assert_close(depth.double(), expected, rtol=0, atol=1e-4)


def test_oracle_agrees_with_finite_differences() -> None:
    random = torch.Generator().manual_seed(3)
    screen = torch.rand(2, 7, 3, generator=random, dtype=torch.float64) * 7 + 0.5
    faces = torch.tensor([[0, 1, 2], [2, 1, 3], [4, 5, 6], [3, 3, 4]])
    torch.autograd.gradcheck(
        lambda points: oracle.optical_depth(points, faces, 8, 0.02), screen.requires_grad_()
    )


#   x 0 1 2 3 4 5 6 7
# y 0 . . . . . . . c      Corners (2, 1), (6, 1), (2, 5) and softness of 1 squared pixel.
#   1 . . +-------+ .      Centres: inside (3.5, 2.5), left (1.5, 2.5), corner (7.5, 0.5), far (7.5, 7.5).
#   2 . l | i  /    .
#   3 . . |  /  . . .
#   5 . . +
CORNERS = torch.tensor([[[2.0, 1.0, 1.0], [6.0, 1.0, 1.0], [2.0, 5.0, 1.0]]])
DISTANCE2 = {(3, 2): +0.5, (1, 2): -0.25, (7, 0): -2.5}  # to x + y = 7; to x = 2; to the corner (6, 1)


@pytest.mark.parametrize("render", [cpu.optical_depth, oracle.optical_depth])
@pytest.mark.parametrize("corners", [[0, 1, 2], [2, 1, 0]])
def test_one_triangle_by_hand(render: Callable[..., Tensor], corners: list[int]) -> None:
    depth = render(CORNERS, torch.tensor([corners]), 8, 1 / 16)[0]
    for (x, y), signed in DISTANCE2.items():
        assert float(depth[y, x]) == pytest.approx(math.log1p(math.exp(signed)), abs=1e-6)
    assert depth[7, 7] == 0.0


@pytest.mark.parametrize("render", [cpu.optical_depth, oracle.optical_depth])
def test_faces_add_up(render: Callable[..., Tensor]) -> None:
    one = render(CORNERS, torch.tensor([[0, 1, 2]]), 8, 1 / 16)
    two = render(CORNERS, torch.tensor([[0, 1, 2], [1, 2, 0]]), 8, 1 / 16)
    torch.testing.assert_close(two, 2 * one)


@pytest.mark.parametrize("render", [cpu.optical_depth, oracle.optical_depth])
def test_outline_moves_with_a_corner_by_hand(render: Callable[..., Tensor]) -> None:
    """S at (1.5, 2.5) is softplus(-(x_left - 1.5)^2), moved by the left side's two corners 5/8 to 3/8."""
    screen = CORNERS.clone().requires_grad_()
    render(screen, torch.tensor([[0, 1, 2]]), 8, 1 / 16)[0, 2, 1].backward()
    slope = -2 * 0.5 / (1 + math.exp(0.25))  # d softplus(x)/dx = sigmoid(-0.25), dx/dx_left = -2 (0.5)
    expected = torch.tensor([[[slope * 5 / 8, 0, 0], [0, 0, 0], [slope * 3 / 8, 0, 0]]])
    torch.testing.assert_close(screen.grad, expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("render", [cpu.optical_depth, oracle.optical_depth])
@pytest.mark.parametrize("depth", [0.01, 0.0, -1.0])
def test_a_face_with_a_corner_at_or_behind_the_camera_is_left_out(
    render: Callable[..., Tensor], depth: float
) -> None:
    screen = CORNERS.clone()
    screen[0, 1, 2] = depth
    assert not render(screen, torch.tensor([[0, 1, 2]]), 8, 1 / 16).any()


def test_threads_do_not_change_the_result(views: Scene) -> None:
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(depth_and_gradient(optical_depth, views, 32, 1e-3, torch.float32))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, two) for one, two in zip(*results, strict=True))
