"""Measuring what an iteration of the engine costs, in CPU time of this process on one thread."""

from __future__ import annotations

import gc
import math
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from refine_engine.cameras.spec import read_camera
from refine_engine.files.mesh_file import read_mesh
from refine_engine.kernels import optical_depth, oracle
from refine_engine.method import losses
from refine_engine.method.config import RefineConfig, Stage
from refine_engine.method.loop import Fit
from refine_engine.method.whole_mesh import fit_whole_mesh
from refine_engine.request import Inputs, read_inputs
from refine_engine.values import Mesh, View


def read_case(folder: Path) -> Inputs:
    """A folder with coarse.obj, silhouette.png and camera.json."""
    mesh, silhouette, camera = (folder / name for name in ("coarse.obj", "silhouette.png", "camera.json"))
    return read_inputs(
        mesh.read_bytes(), mesh.name, silhouette.read_bytes(), read_camera(camera.read_bytes())
    )


def read_mesh_file(path: Path) -> Mesh:
    """The welded mesh of a file."""
    return read_mesh(path.read_bytes(), path.name).mesh


def start(mesh: Mesh, view: View, config: RefineConfig) -> Fit:
    """A run after its first two iterations: everything is compiled and in memory."""
    config = replace(config, stages=(replace(config.stages[-1], iterations=10_000),))
    fit = Fit(fit_whole_mesh(mesh, [view], config), config)
    fit.enter(config.stages[-1])
    for _ in range(2):
        fit.step()
    return fit


def cpu_seconds(work: Callable[[], object], seconds: float = 2.0) -> float:
    """Median CPU time of a call, over 3 to 1,000 calls for about `seconds`; the first does not count."""
    work()
    gc.collect()
    times: list[float] = []
    while len(times) < 3 or (sum(times) < seconds and len(times) < 1000):
        before = time.process_time()
        work()
        times.append(time.process_time() - before)
    return float(np.median(times))


def wall_seconds(work: Callable[[], object], repeats: int = 7) -> float:
    """Least wall time of `repeats` calls; the first does not count."""
    work()
    times = []
    for _ in range(repeats):
        before = time.perf_counter()
        work()
        times.append(time.perf_counter() - before)
    return min(times)


def peak_memory_bytes() -> int:
    """The most resident memory that this process has had."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage would count the parent's memory at the start of this process
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def stage_seconds(fit: Fit) -> dict[str, float]:
    """CPU seconds of the parts of one iteration, forward and backward, and of the whole as "iteration"."""
    network, config = fit.network, fit.config
    features = fit.features().detach().requires_grad_(config.train_encoder)
    with torch.no_grad():
        offsets, confidence = network(features, fit.coarse, fit.topology)
        depth, _ = fit.render(fit.coarse + offsets, confidence)
    depth_leaf = depth.detach().requires_grad_()
    (upstream,) = torch.autograd.grad(fit.silhouette(depth_leaf), depth_leaf)
    vertices = (fit.coarse + offsets).requires_grad_()
    confidence = confidence.requires_grad_()

    def graph() -> None:
        moved, sigma = network(features, fit.coarse, fit.topology)
        (moved.sum() + sigma.sum() if config.learn_confidence else moved.sum()).backward()

    def renders() -> None:
        soft, image_symmetry = fit.render(vertices, confidence)
        ((soft * upstream).sum() + image_symmetry).backward()

    def vertex_symmetry() -> None:
        fit.mirrored(vertices, confidence)[1].backward()

    def remaining_losses() -> None:
        moved = vertices - fit.coarse
        folds, smooth = fit.smoothness(vertices, moved)
        (fit.silhouette(depth_leaf) + losses.displacement(moved) + folds + smooth).backward()

    parts: dict[str, Callable[[], object]] = {
        "graph convolutions": graph,
        "renders": renders,
        "vertex symmetry": vertex_symmetry,
        "other losses": remaining_losses,
        "optimiser": fit.optimiser.step,
    }
    if config.train_encoder:
        parts = {"encoder": lambda: fit.features().sum().backward(), **parts}
    iteration = cpu_seconds(fit.step)  # first: the optimiser alone, on the same gradients, leads astray
    return {name: cpu_seconds(part) for name, part in parts.items()} | {"iteration": iteration}


def network_flop(fit: Fit) -> int:
    """Floating-point operations of one iteration's matrix products and convolutions, as torch counts them."""
    with FlopCounterMode(display=False) as counter:
        fit.step()
    return int(counter.get_total_flops())


def peak_flop_per_second(size: int = 1536) -> float:
    """What this machine reaches on one thread in a large float32 matrix product."""
    a, b = torch.randn(size, size), torch.randn(size, size)
    return 2 * size**3 / cpu_seconds(lambda: a @ b)


def render_seconds(screen: Tensor, faces: Tensor, side: int, softness: float) -> tuple[float, float]:
    """CPU seconds of the soft renders of all views, forward and backward, of the CPU back end."""
    points = screen.detach().requires_grad_()
    depth = optical_depth(points, faces, side, softness)
    upstream = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
    forward = cpu_seconds(lambda: optical_depth(points, faces, side, softness))
    return forward, cpu_seconds(lambda: depth.backward(upstream, retain_graph=True))


def screen_of(fit: Fit) -> Tensor:
    """The vertices on the screens of all soft renders of an iteration: (views, V, 3)."""
    screen = fit.target.project(fit.coarse)
    if fit.normal is None or not fit.config.weights.image_symmetry:
        return screen
    return torch.cat([screen, fit.pairs.project(fit.coarse)])


@njit(cache=True)
def _pairs(points: NDArray[np.float32], faces: NDArray[np.int64], side: int, radius: float) -> int:
    count = 0
    for f in range(len(faces)):
        x, y = points[faces[f], 0], points[faces[f], 1]
        for row in range(max(0, int(y.min() - radius)), min(side, int(y.max() + radius) + 1)):
            for column in range(max(0, int(x.min() - radius)), min(side, int(x.max() + radius) + 1)):
                px, py = column + 0.5, row + 0.5
                nearest2, left, right = radius * radius, True, True
                for i in range(3):
                    ux, uy = x[(i + 1) % 3] - x[i], y[(i + 1) % 3] - y[i]
                    dx, dy = px - x[i], py - y[i]
                    t = min(max((dx * ux + dy * uy) / max(ux * ux + uy * uy, 1e-12), 0.0), 1.0)
                    nearest2 = min(nearest2, (dx - t * ux) ** 2 + (dy - t * uy) ** 2)
                    left, right = left and ux * dy > uy * dx, right and ux * dy < uy * dx
                count += left or right or nearest2 < radius * radius
    return count


def contributing_pairs(screen: Tensor, faces: Tensor, side: int, softness: float) -> int:
    """How many (pixel, face) have the face inside the pixel's reach: the renderer's work, without waste."""
    radius = math.sqrt(oracle.CUTOFF * softness) * side / 2
    return sum(_pairs(view.numpy(), faces.numpy(), side, radius) for view in screen.detach())


def at_size(config: RefineConfig, side: int) -> RefineConfig:
    """One stage of soft renders of `side` pixels."""
    last = config.stages[-1]
    return replace(config, stages=(Stage(last.iterations, side, last.softness),))
