"""The hard rasteriser, what it carries to the pixels, and the loss that is fused with it."""

from collections.abc import Callable
from typing import Protocol

import pytest
import torch
from torch import Tensor

from refine_engine.kernels import Fragments, cpu, image_symmetry, interpolate, oracle, rasterize

COST = 0.0005


class Scene(Protocol):
    @property
    def screen(self) -> Tensor: ...
    @property
    def faces(self) -> Tensor: ...


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("size", [(16, 16), (21, 37), (40, 25)])
def test_cpu_agrees_with_the_oracle(
    make_scene: Callable[[int], Scene], size: tuple[int, int], orthographic: bool
) -> None:
    scene = make_scene(min(size))
    seen = cpu.rasterize(scene.screen, scene.faces, size, orthographic)
    expected = oracle.rasterize(scene.screen.double(), scene.faces, size, orthographic)
    assert seen.face.shape == (len(scene.screen), *size)
    same = seen.face == expected.face
    assert float(same.float().mean()) > 0.99  # the others: centres on an edge, or faces that cross there
    error = (seen.barycentric - expected.barycentric).abs().amax(-1)
    assert float(error[same].max()) < 1e-3
    near, far = depth_of(seen, scene), depth_of(expected, scene)
    edge = (seen.face < 0) != (expected.face < 0)
    torch.testing.assert_close(near[~edge], far[~edge], rtol=1e-3, atol=1e-4)


def depth_of(fragments: Fragments, scene: Scene) -> Tensor:
    """(B, H, W), 0 on background."""
    corners = scene.faces[fragments.face.clamp_min(0)]
    z = torch.stack([points[index, 2] for points, index in zip(scene.screen, corners, strict=True)])
    return (z * fragments.barycentric).sum(-1).float()


# Two triangles over one another in 4 x 4 pixels; corners a, b, c of each; near: the upper left half.
#
#   a--------b     near: a (0, 0) depth 1, b (4, 0) depth 1, c (0, 4) depth 2
#   |      /       far:  the whole image and more, at depth 3
#   |   /
#   c
TWO = torch.tensor([[[0, 0, 1], [4, 0, 1], [0, 4, 2], [-9, -9, 3], [20, -9, 3], [-9, 20, 3]]]).float()
PAIR = torch.tensor([[3, 4, 5], [0, 1, 2]])


both_renders = pytest.mark.parametrize("render", [cpu.rasterize, oracle.rasterize])


@both_renders
def test_the_near_face_hides_the_far_one(render: Callable[..., Fragments]) -> None:
    seen = render(TWO, PAIR, (4, 4))
    assert seen.face[0, 0, :3].tolist() == [1, 1, 1]
    assert seen.face[0, 3, 1:].tolist() == [0, 0, 0]


@both_renders
def test_weights_by_hand(render: Callable[..., Fragments]) -> None:
    """At centre (0.5, 1.5) a has 1/2 of the screen triangle, b 1/8, c 3/8."""
    perspective, orthographic = render(TWO, PAIR, (4, 4)), render(TWO, PAIR, (4, 4), orthographic=True)
    # each over its depth: 1/2, 1/8, 3/16, together 13/16
    torch.testing.assert_close(perspective.barycentric[0, 1, 0], torch.tensor([8 / 13, 2 / 13, 3 / 13]))
    torch.testing.assert_close(orthographic.barycentric[0, 1, 0], torch.tensor([1 / 2, 1 / 8, 3 / 8]))


# A floor that falls from depth 1/2 at the left border of 8 x 8 pixels to 5/2 at the right one, and a wall at
# depth 1. Of an orthographic view, the floor's depth at x is 1/2 + x/4: it goes through the wall at x = 2. In
# perspective the inverse of the depth is 2 - x/5: x = 5.
CORNERS = [(0, 0), (8, 0), (0, 8), (8, 8)]
FLOOR = [(x, y, 0.5 if x == 0 else 2.5) for x, y in CORNERS]
CROSSING = torch.tensor([FLOOR + [(x, y, 1.0) for x, y in CORNERS]])
QUADS = torch.tensor([[0, 1, 2], [2, 1, 3], [4, 5, 6], [6, 5, 7]])


@both_renders
@pytest.mark.parametrize(("orthographic", "crossing"), [(True, 2), (False, 5)])
def test_faces_that_cross_by_hand(
    render: Callable[..., Fragments], orthographic: bool, crossing: int
) -> None:
    seen = render(CROSSING, QUADS, (8, 8), orthographic)
    in_front = (seen.face[0] <= 1).tolist()
    assert in_front == [[column < crossing for column in range(8)]] * 8


@both_renders
@pytest.mark.parametrize(("orthographic", "depth"), [(True, 0.875), (False, 1 / 1.7)])
def test_depth_by_hand(render: Callable[..., Fragments], orthographic: bool, depth: float) -> None:
    """At x = 1.5 of the floor alone."""
    seen = render(CROSSING, QUADS[:2], (8, 8), orthographic)
    z = (CROSSING[0, QUADS[seen.face[0]], 2] * seen.barycentric[0]).sum(-1)
    torch.testing.assert_close(z[:, 1], torch.full((8,), depth))


@both_renders
@pytest.mark.parametrize(("height", "drawn"), [(5e-6, False), (2e-5, True)])
def test_a_face_without_area_is_not_seen(
    render: Callable[..., Fragments], height: float, drawn: bool
) -> None:
    """Its long side runs through pixel centres. Twice its area is 8 heights; 64e-6 count as none."""
    sliver = torch.tensor([[[0, 0.5, 1], [8, 0.5, 1], [4, 0.5 + height, 1]]])
    for corners in ([0, 1, 2], [2, 1, 0]):
        seen = render(sliver, torch.tensor([corners]), (2, 8))
        assert (seen.face[0, 0] >= 0).tolist() == [drawn] * 8
        assert not (seen.face[0, 1] >= 0).any()


@both_renders
def test_background(render: Callable[..., Fragments]) -> None:
    seen = render(TWO, PAIR[1:], (4, 6))
    assert seen.face[0, 3, 3] == -1
    assert seen.barycentric[0, 3, 3].tolist() == [0, 0, 0]


def test_interpolate_is_the_weighted_sum_of_the_corners(views: Scene) -> None:
    seen = rasterize(views.screen, views.faces, (24, 32))
    attribute = torch.rand(views.screen.shape[1], generator=torch.Generator().manual_seed(2))
    image = interpolate(seen, views.faces, attribute)
    for view, y, x in torch.cartesian_prod(torch.arange(3), torch.arange(0, 24, 5), torch.arange(0, 32, 5)):
        face = int(seen.face[view, y, x])
        expected = 0.0
        if face >= 0:
            for corner, weight in zip(views.faces[face], seen.barycentric[view, y, x], strict=True):
                expected += float(weight) * float(attribute[corner])
        assert float(image[view, y, x]) == pytest.approx(expected, abs=1e-6)


def symmetry_inputs(scene: Scene) -> tuple[Fragments, list[Tensor]]:
    """What is visible, and leaf tensors: optical depths of two sets of views, confidences per vertex."""
    random = torch.Generator().manual_seed(4)
    visible = rasterize(scene.screen, scene.faces, (32, 32))
    depths = 5 * torch.rand(2, 3, 32, 32, generator=random).square()
    depths[:, :, ::7] = 0
    depths[:, :, 3::7] *= 40  # thickly covered
    confidence = torch.rand(scene.screen.shape[1], generator=random)
    confidence[scene.faces[:20]] = 0  # below the least that the logarithm sees
    return visible, [tensor.clone().requires_grad_() for tensor in (*depths, confidence)]


def test_fused_image_symmetry_is_the_loss(views: Scene) -> None:
    visible, fused_inputs = symmetry_inputs(views)
    fused = cpu.image_symmetry(fused_inputs[0], fused_inputs[1], visible, views.faces, fused_inputs[2], COST)
    (3 * fused).backward()
    _, plain_inputs = symmetry_inputs(views)
    seen, mirrored, confidence = plain_inputs
    covered = (visible.face >= 0).float()
    sigma = interpolate(visible, views.faces, confidence)
    plain = oracle.image_symmetry(seen, mirrored, sigma, covered, COST)
    (3 * plain).backward()
    torch.testing.assert_close(fused, plain, rtol=1e-5, atol=0)
    for one, other in zip(fused_inputs, plain_inputs, strict=True):
        assert one.grad is not None
        assert other.grad is not None
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-3, atol=1e-4 * float(other.grad.abs().max()))


def test_threads_do_not_change_the_result(views: Scene) -> None:
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            visible, inputs = symmetry_inputs(views)
            loss = image_symmetry(inputs[0], inputs[1], visible, views.faces, inputs[2], COST)
            loss.backward()
            results.append([visible.face, visible.barycentric, loss, *(tensor.grad for tensor in inputs)])
    finally:
        torch.set_num_threads(before)
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)
