"""The CUDA back end on a real card; everything here skips where there is none."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import pytest
import torch
from torch import Tensor

from refine_engine import Mesh, RefineConfig, View, refine
from refine_engine.kernels import cuda, graph, interpolate, oracle
from refine_engine.method.config import Stage
from refine_engine.method.symmetry import nearest_mirrored

pytestmark = pytest.mark.skipif(
    not torch.cuda.is_available() or torch.version.hip is not None, reason="no CUDA device"
)

SIDE = 224
SOFTNESS = 1e-4


def scene(seed: int, views: int = 3) -> tuple[Tensor, Tensor]:
    """(B, V, 3) and (F, 3) on the card: triangles about as large as those of a mesh of 1,500 vertices."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.rand(views, 200, 1, 3, generator=generator) * SIDE
    corners = centre + (torch.rand(views, 200, 3, 3, generator=generator) - 0.5) * 24
    corners[..., 2] = corners[..., 2].abs() / SIDE + 0.5
    return corners.reshape(views, -1, 3).cuda(), torch.arange(600).reshape(-1, 3).cuda()


def with_gradient(render: Any, screen: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    points = screen.clone().requires_grad_()
    depth = render(points, faces, SIDE, SOFTNESS)
    weight = torch.randn(depth.shape, generator=torch.Generator().manual_seed(1)).to(depth)
    (depth * weight).sum().backward()
    assert points.grad is not None
    return depth.detach(), points.grad


@pytest.mark.parametrize("seed", range(3))
def test_optical_depth_matches_the_specification(seed: int) -> None:
    screen, faces = scene(seed)
    depth, grad = with_gradient(cuda.optical_depth, screen, faces)
    expected, expected_grad = with_gradient(oracle.optical_depth, screen.double(), faces)
    torch.testing.assert_close(depth.double(), expected, rtol=1e-4, atol=1e-4)
    assert float((grad - expected_grad).norm() / expected_grad.norm()) < 1e-3


def test_gradient_is_the_slope_of_the_value() -> None:
    screen, faces = scene(4, views=1)
    _, grad = with_gradient(cuda.optical_depth, screen, faces)
    direction = grad / grad.abs().max()  # uphill, where the slope stands out from rounding
    step = 1e-2  # pixels
    ends = []
    weight = torch.randn(1, SIDE, SIDE, generator=torch.Generator().manual_seed(1)).to(screen)
    for sign in (1, -1):
        depth = cuda.optical_depth(screen + sign * step * direction, faces, SIDE, SOFTNESS)
        ends.append(float((depth.double() * weight).sum()))
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float((grad * direction).sum()), rel=0.02)


@pytest.mark.parametrize("orthographic", [False, True])
def test_rasterize_matches_the_specification(orthographic: bool) -> None:
    screen, faces = scene(5)
    seen = cuda.rasterize(screen, faces, (SIDE, 180), orthographic)
    expected = oracle.rasterize(screen, faces, (SIDE, 180), orthographic)
    same = seen.face == expected.face
    assert float(same.float().mean()) > 0.9999  # a pixel centre on an edge may fall to either side
    torch.testing.assert_close(seen.barycentric[same], expected.barycentric[same], rtol=1e-3, atol=1e-4)


def test_image_symmetry_matches_the_plain_loss() -> None:
    screen, faces = scene(6)
    results = []
    for fused in (True, False):
        seen = oracle.optical_depth(screen, faces, SIDE, SOFTNESS).requires_grad_()
        mirrored = oracle.optical_depth(screen + 1, faces, SIDE, SOFTNESS).requires_grad_()
        confidence = torch.linspace(0.1, 1, 600, device="cuda").requires_grad_()
        fragments = oracle.rasterize(screen + 1, faces, (SIDE, SIDE))
        if fused:
            value = cuda.image_symmetry(seen, mirrored, fragments, faces, confidence, 5e-4)
        else:
            sigma, covered = interpolate(fragments, faces, confidence), (fragments.face >= 0).float()
            value = oracle.image_symmetry(seen, mirrored, sigma, covered, 5e-4)
        results.append([value.detach(), *torch.autograd.grad(value, (seen, mirrored, confidence))])
    for one, other in zip(*results, strict=True):
        assert float((one - other).norm() / other.norm()) < 1e-4


@pytest.mark.parametrize("count", [7, 1502, 20_000])
def test_nearest_mirrored_matches_all_distances(count: int) -> None:
    vertices = torch.rand(count, 3, generator=torch.Generator().manual_seed(count)).cuda()
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0])).cuda()
    index = nearest_mirrored(vertices, mirror)
    distance = (vertices @ mirror - vertices[index]).norm(dim=1)
    expected = torch.cat(
        [torch.cdist(part.double(), vertices.double()).amin(1) for part in (vertices @ mirror).split(2000)]
    )
    torch.testing.assert_close(distance.double(), expected, rtol=1e-5, atol=1e-6)


def test_every_bit_is_the_same_in_every_run() -> None:
    screen, faces = scene(7)
    runs = [with_gradient(cuda.optical_depth, screen, faces) for _ in range(5)]
    for run in runs[1:]:
        assert torch.equal(run[0], runs[0][0])
        assert torch.equal(run[1], runs[0][1])


def test_convolutions_keep_float32() -> None:
    before = torch.backends.cudnn.allow_tf32
    generator = torch.Generator().manual_seed(0)
    image, weight = (
        torch.randn(1, 64, 56, 56, generator=generator),
        torch.randn(64, 64, 3, 3, generator=generator),
    )
    expected = torch.conv2d(image.double(), weight.double())
    try:
        cuda.keep_float32()
        result = torch.conv2d(image.cuda(), weight.cuda()).double().cpu()
    finally:
        torch.backends.cudnn.allow_tf32 = before
    assert float((result - expected).norm() / expected.norm()) < 1e-5  # 3e-4 in TF32


def test_a_recorded_render_follows_its_input() -> None:
    screen, faces = scene(8)
    out = torch.empty(len(screen), SIDE, SIDE, device="cuda")

    def iteration() -> None:
        out.copy_(cuda.optical_depth(screen, faces, SIDE, SOFTNESS))

    with graph.repeatable(iteration, screen.device) as repeat:
        for _ in range(graph.EAGER_RUNS + 3):
            screen += 0.5
            repeat()
            assert torch.equal(out, cuda.optical_depth(screen, faces, SIDE, SOFTNESS))


def count_up(times: int, rounds: int) -> list[float]:
    """Adds 1 to every element of a product of matrices, in recordings that end with replays under way."""
    results = []
    for _ in range(rounds):
        total = torch.zeros(256, 256, device="cuda")
        one = torch.eye(256, device="cuda")

        def iteration(total: Tensor = total, one: Tensor = one) -> None:
            total.add_((one @ one).sum() / 256)

        with graph.repeatable(iteration, total.device) as repeat:
            for _ in range(times):
                repeat()
        results.append(float(total.mean()))
    return results


def test_a_recording_ends_with_its_replays_done() -> None:
    streams = len(graph._streams)
    assert count_up(200, 40) == [200.0] * 40  # more recordings than torch has streams
    assert len(graph._streams) <= streams + 1


def test_threads_record_and_replay_side_by_side() -> None:
    results: list[list[float]] = []
    threads = [threading.Thread(target=lambda: results.append(count_up(100, 10))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [[100.0] * 10] * 4


OUT_OF_MEMORY = """
import torch
from refine_engine.kernels.graph import EAGER_RUNS, repeatable

calls = []

def iteration():
    calls.append(1)
    if len(calls) > EAGER_RUNS:
        torch.empty(2**44, dtype=torch.uint8, device="cuda")

try:
    with repeatable(iteration, torch.device("cuda")) as repeat:
        for _ in range(EAGER_RUNS + 1):
            repeat()
except torch.OutOfMemoryError:
    print("told as such")
"""


def test_a_lack_of_memory_while_recording_is_told() -> None:
    """In a process of its own, which has to end afterwards."""
    process = subprocess.run([sys.executable, "-c", OUT_OF_MEMORY], capture_output=True, text=True)
    assert process.stdout == "told as such\n", process.stderr


def on_the_card(case: tuple[Mesh, list[View]]) -> tuple[Mesh, list[View]]:
    mesh, views = case
    there = [View(view.silhouette.cuda(), view.camera) for view in views]
    return Mesh(mesh.vertices.cuda(), mesh.faces.cuda()), there


def test_the_default_gives_the_same_bits_and_its_memory_back(
    octahedron_case: tuple[Mesh, list[View]],
) -> None:
    case = on_the_card(octahedron_case)
    config = RefineConfig(stages=(Stage(20, 56, 1e-3), Stage(40, 112, 6e-4)), agreement=None)
    first = refine(*case, config)
    held = torch.cuda.memory_allocated()
    second = refine(*case, config)
    assert torch.equal(first.mesh.vertices, second.mesh.vertices)
    assert torch.equal(first.confidence, second.confidence)
    assert first.loss_curve == second.loss_curve
    del second
    assert torch.cuda.memory_allocated() <= held


@pytest.mark.slow
@pytest.mark.parametrize("train_encoder", [False, True])
def test_recorded_and_eager_refinement_agree(
    octahedron_case: tuple[Mesh, list[View]], monkeypatch: pytest.MonkeyPatch, train_encoder: bool
) -> None:
    """Not bit for bit with the encoder: torch adds the gradients of `grid_sample` in any order.

    400 steps amplify that.
    """
    case = on_the_card(octahedron_case)
    config = RefineConfig(stages=(Stage(400, 112, 6e-4),), agreement=None, train_encoder=train_encoder)
    recorded = refine(*case, config)
    monkeypatch.setattr(graph, "EAGER_RUNS", 10**9)
    eager = refine(*case, config)
    one, other = recorded.loss_curve["total"], eager.loss_curve["total"]
    assert one[:20] == pytest.approx(other[:20], rel=1e-3)
    assert min(one) == pytest.approx(min(other), rel=0.02)
