"""The method: fit a network to one mesh, one silhouette and one camera (paper, section 3).

    network -> displacement, confidence -> deform -> render -> losses -> step; keep the best; report.

Everything that is constant is built before the loop. Inside it no value goes to the host except when progress
is reported, at most twice a second, so that one iteration can be captured in a CUDA graph.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from . import losses
from .cameras import project
from .config import RefineConfig, Stage
from .errors import Cancelled, Diverged
from .network import Refiner, initialise
from .problem import Frame, Target, resize, symmetry_views, unit_normal
from .scene import Mesh, Progress, Result, View
from .silhouette import cpu, interpolate, optical_depth, rasterize
from .symmetry import mirror_matrix, nearest_mirrored
from .topology import Topology, neighbour_sum

TERMS = ("silhouette", "image_symmetry", "vertex_symmetry", "displacement", "normal_consistency", "laplacian")
REPORT_INTERVAL_S = 0.5


def refine(
    mesh: Mesh,
    views: Sequence[View],
    config: RefineConfig,
    report: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Result:
    """Refine a coarse mesh so that it agrees with its silhouettes and stays plausible where they say nothing."""
    started = time.monotonic()
    objective = Objective(mesh, views, config)
    generator = torch.Generator().manual_seed(config.seed)
    network = Refiner()
    initialise(network, float(objective.topology.degree.mean()), generator)
    network.to(mesh.vertices.device)
    optimiser = torch.optim.Adam(network.parameters(), config.learning_rate, fused=True)
    curve = torch.zeros(config.iterations, len(TERMS) + 1)
    iteration = 0
    last = 0.0
    best = None
    for stage in config.stages:
        objective.enter(stage)
        best_total = torch.tensor(float("inf"))
        for _ in range(stage.iterations):
            if cancelled is not None and cancelled():
                raise Cancelled(f"cancelled after {iteration} of {config.iterations} iterations")
            offsets, confidence = network(objective.seen, objective.grid, objective.coarse, objective.topology)
            terms = objective.terms(offsets, confidence)
            total = sum(terms)
            optimiser.zero_grad()
            total.backward()
            optimiser.step()
            with torch.no_grad():
                curve[iteration] = torch.stack([*terms, total])
                better = total < best_total
                best_total = torch.where(better, total, best_total)
                best = (offsets.detach(), confidence.detach()) if best is None else (
                    torch.where(better, offsets, best[0]), torch.where(better, confidence, best[1]))
            iteration += 1
            now = time.monotonic()
            if report and now - last > REPORT_INTERVAL_S:
                last = now
                report(Progress(iteration, config.iterations, dict(zip((*TERMS, "total"), curve[iteration - 1].tolist())), 0.0))
    offsets, confidence = best
    vertices = mesh.vertices + offsets * objective.frame.scale
    return Result(Mesh(vertices, mesh.faces), offsets * objective.frame.scale, confidence, 0,
                  {n: curve[:, i].tolist() for i, n in enumerate((*TERMS, "total"))}, 0, 0, time.monotonic() - started)


class Objective:
    def __init__(self, mesh, views, config):
        self.config, self.views = config, views
        self.frame = Frame.of(mesh, config)
        self.coarse = self.frame.normalise(mesh.vertices)
        self.topology = Topology.of(mesh.faces, len(mesh.vertices))
        self.mirror = mirror_matrix(unit_normal(config, self.coarse))
        t = Target.of(views, self.frame, config.encoder_size)
        self.seen = t.silhouette[:1, None]
        screen = project(self.coarse, t.world_to_camera[:1], t.intrinsics[:1], t.orthographic)
        self.grid = (screen[..., :2] * 2 / config.encoder_size - 1)[:, None]

    def enter(self, stage: Stage):
        self.stage = stage
        self.target = Target.of(self.views, self.frame, stage.render_size)
        self.p, self.tp, self.k = symmetry_views(self.config, stage.render_size, self.coarse.device)

    def terms(self, offsets, confidence):
        c, stage, w = self.config, self.stage, self.config.weights
        vertices = self.coarse + offsets
        t = self.target
        mesh_views = project(vertices, t.world_to_camera, t.intrinsics, t.orthographic)
        both = project(vertices, torch.cat([self.p, self.tp]), torch.cat([self.k, self.k]))
        depth = optical_depth(torch.cat([mesh_views, both]), self.topology.faces, stage.render_size, stage.softness)
        n, m = len(mesh_views), len(self.p)
        fragments = rasterize(both[m:], self.topology.faces, (stage.render_size,) * 2)
        nearest = nearest_mirrored(vertices, self.mirror)
        mean = neighbour_sum(vertices, self.topology) / self.topology.degree
        return [
            w.silhouette * losses.silhouette(depth[:n], t.silhouette, t.known),
            w.image_symmetry * cpu.image_symmetry(depth[n:n+m], depth[n+m:], fragments, self.topology.faces, confidence, c.confidence_cost),
            w.vertex_symmetry * losses.vertex_symmetry(vertices, nearest, self.mirror, confidence, c.confidence_cost),
            w.displacement * losses.displacement(offsets),
            w.normal_consistency * losses.normal_consistency(vertices, self.topology),
            w.laplacian * losses.laplacian(vertices, mean),
        ]
