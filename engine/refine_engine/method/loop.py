"""The method: fit a network to one mesh, its silhouettes and cameras (paper, section 3).

    whole mesh -> [ network -> displacement, confidence -> deform -> render -> losses -> step ] -> judge

`refine` is the run, `Fit` what it optimises, `Fit.step` one iteration. A step works on tensors that were
there before it and sends nothing to the host, so that on a card it is captured in a CUDA graph
(`repeatable`); the host looks at most twice a second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from ..cameras.seen import mean_silhouette_iou
from ..errors import Cancelled, Diverged
from ..kernels import optical_depth, rasterize
from ..kernels.graph import repeatable
from ..values import Mesh, Progress, Result, View
from . import losses
from .best import Best
from .config import RefineConfig, Stage
from .features import features_of
from .network import make_network
from .opening import find_unexplained
from .outcome import State, confidence_of, judge, keep
from .symmetry import best_confidence, mirror_matrix, nearest_mirrored
from .topology import Topology, neighbour_mean
from .views import Frame, Region, SymmetryViews, Target
from .whole_mesh import WholeMesh, fit_whole_mesh

TERMS = ("silhouette", "image_symmetry", "vertex_symmetry", "displacement", "normal_consistency", "laplacian")
REPORT_INTERVAL_S = 0.5
Snapshot: TypeAlias = dict[str, Any]  # plain values and tensors


def refine(
    mesh: Mesh,
    views: Sequence[View],
    config: RefineConfig,
    report: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    checkpoints: Checkpoints | None = None,
) -> Result:
    """Refine a coarse mesh so that it agrees with its silhouettes and stays plausible where they say nothing.

    Mesh and views are on one device, which does the work. `report` hears of the progress at most twice a
    second and of the last iteration; `cancelled` is asked before every iteration. The same seed, device and
    number of threads give the same result, also when a run goes on from a checkpoint of another one that was
    interrupted. Vertices that no face uses stay where they are, with confidence 1.

    Raises:
        Cancelled: `cancelled` said so.
        Diverged: a loss became NaN or infinite.
    """
    started = time.monotonic()
    iou_before = mean_silhouette_iou(mesh, views)
    used, faces = mesh.faces.unique(return_inverse=True)
    compact = Mesh(mesh.vertices[used], faces)
    if config.agreement is not None and iou_before >= config.agreement:
        state = keep(compact, views, config, iou_before, report)
    else:
        state = _optimise(compact, views, config, iou_before, report, cancelled, checkpoints)
    there = state.there if config.topology != "fixed" else torch.ones_like(state.there)
    vertices = mesh.vertices.index_copy(0, used, state.mesh.vertices)
    return Result(
        mesh=Mesh(vertices, mesh.faces[there]),
        kept_faces=there,
        displacement=vertices - mesh.vertices,
        confidence=torch.ones_like(vertices[:, 0]).index_copy(0, used, state.confidence),
        best_iteration=state.best_iteration,
        loss_curve=state.loss_curve,
        silhouette_iou_before=iou_before,
        silhouette_iou_after=mean_silhouette_iou(Mesh(vertices, mesh.faces[there]), views),
        outcome=state.outcome,
        plane=state.plane,
        camera_turn_degrees=state.camera_turn_degrees,
        seconds=time.monotonic() - started,
        warnings=state.warnings,
    )


def _optimise(
    mesh: Mesh,
    views: Sequence[View],
    config: RefineConfig,
    iou_before: float,
    report: Callable[[Progress], None] | None,
    cancelled: Callable[[], bool] | None,
    checkpoints: Checkpoints | None,
) -> State:
    """Fit the mesh as a whole, then the network; every vertex of `mesh` is used by a face."""
    iteration, reported = 0, -math.inf

    def proceed() -> None:
        nonlocal reported
        if cancelled is not None and cancelled():
            raise Cancelled(f"cancelled after {iteration} of {config.iterations} iterations")
        now = time.monotonic()
        if report and iteration == 0 and now - reported > REPORT_INTERVAL_S:
            report(Progress(0, config.iterations, {}, iou_before))
            reported = now

    whole = fit_whole_mesh(mesh, views, config, proceed)
    fit = Fit(whole, config)
    saved = checkpoints.last() if checkpoints else None
    iteration = saved["iteration"] if saved else 0
    end = 0
    for stage in config.stages:
        begin, end = end, end + stage.iterations
        if saved and end < iteration:
            continue
        fit.enter(stage)
        if saved and begin < iteration:
            fit.restore(saved)
        with repeatable(fit.step, mesh.vertices.device) as step:
            for _ in range(max(begin, iteration), end):
                proceed()
                step()
                iteration += 1
                if checkpoints and checkpoints.due():
                    checkpoints.keep(fit.snapshot(iteration))
                now = time.monotonic()
                if report and (now - reported > REPORT_INTERVAL_S or iteration == config.iterations):
                    report(fit.progress(iteration))
                    reported = now
    fit.progress(config.iterations)
    return judge(mesh, whole, fit.state(), config, iou_before)


class Checkpoints(Protocol):
    """Where a run leaves its state now and then, so that another run of the same inputs can go on from it."""

    def last(self) -> Snapshot | None:
        """What the latest one kept, on the device of this run."""

    def due(self) -> bool:
        """Asked after every iteration."""

    def keep(self, snapshot: Snapshot) -> None:
        """Copy it before this returns: the run goes on in the same tensors."""


class Fit:
    """What one run optimises: the network, and what its losses compare."""

    def __init__(self, whole: WholeMesh, config: RefineConfig) -> None:
        self.whole, self.config, self.views = whole, config, whole.views
        self.frame = Frame.of(whole.mesh, whole.plane)
        self.coarse = self.frame.normalise(whole.mesh.vertices)  # (V, 3)
        self.topology = Topology.of(whole.mesh.faces, len(self.coarse))
        self.seen_faces = whole.mesh.faces[whole.there]
        self.folds = losses.fold_angles(self.coarse, self.topology)
        self.normal = None if whole.plane is None else whole.plane.normal
        if config.crop:
            self.regions = [Region.around(view, whole.mesh) for view in whole.views]
        else:
            self.regions = [Region.whole(view.camera) for view in whole.views]

        seen = Target.of(self.views[:1], self.regions[:1], self.frame, config.encoder_size)
        grid = (seen.project(self.coarse)[..., :2] * 2 / seen.side - 1)[:, None]  # (1, 1, V, 2)
        self.network = make_network(float(self.topology.degree.mean()), config.seed, self.coarse.device)
        self.features = features_of(self.network, seen.silhouette[:, None], grid, config.train_encoder)
        trained = [p for p in self.network.parameters() if p.requires_grad]
        on_card = self.coarse.is_cuda
        self.optimiser = torch.optim.Adam(trained, config.learning_rate, fused=True, capturable=on_card)
        self.best = Best(self.coarse, config.iterations, len(TERMS))
        self.iou = self.coarse.new_zeros(())

    def enter(self, stage: Stage) -> None:
        """Totals of different stages do not compare: the best iterate is the best of the last one."""
        self.stage = stage
        self.target = Target.of(self.views, self.regions, self.frame, stage.render_size)
        if self.config.unexplained_depth is not None:
            lost = find_unexplained(self.coarse, self.seen_faces, self.target, self.config.unexplained_depth)
            self.target = replace(self.target, known=self.target.known * ~lost)
        if self.normal is not None and self.config.weights.image_symmetry:
            self.pairs = SymmetryViews.of(self.config, stage.render_size, self.normal)
        self.best.forget()

    def step(self) -> None:
        """One iteration."""
        offsets, confidence = self.network(self.features(), self.coarse, self.topology)
        terms, confidence = self.terms(offsets, confidence)
        self.optimiser.zero_grad()
        terms.sum().backward()
        self.optimiser.step()
        self.best.keep(terms.detach(), offsets.detach(), confidence.detach())
        self.measure(self.coarse + offsets.detach())

    def terms(self, offsets: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        """The six weighted losses (6,) of displacements (V, 3), and the confidences (V,) that they count."""
        vertices = self.coarse + offsets
        confidence, vertex_symmetry = self.mirrored(vertices, confidence)
        depth, image_symmetry = self.render(vertices, confidence)
        weights = self.config.weights
        terms = [
            weights.silhouette * self.silhouette(depth),
            weights.image_symmetry * image_symmetry,
            weights.vertex_symmetry * vertex_symmetry,
            weights.displacement * losses.displacement(offsets),
            *self.smoothness(vertices, offsets),
        ]
        return torch.stack(terms), confidence

    def measure(self, vertices: Tensor) -> None:
        """2D IoU of the hard render, as the result's: known pixels, mean over views; 0 if nothing is seen."""
        side = self.stage.render_size
        covered = rasterize(self.target.project(vertices), self.seen_faces, (side, side)).face >= 0
        known = self.target.known > 0.5
        covered, wanted = covered & known, (self.target.silhouette > 0.5) & known
        both, either = (covered & wanted).flatten(1).sum(1), (covered | wanted).flatten(1).sum(1)
        self.iou.copy_((both / either.clamp_min(1)).mean())

    def render(self, vertices: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        """Optical depth at the input cameras (B, N, N), and the image symmetry loss of the view pairs."""
        faces, side = self.seen_faces, self.stage.render_size
        screen = self.target.project(vertices)
        if self.normal is None or not self.config.weights.image_symmetry:
            return optical_depth(screen, faces, side, self.stage.softness), confidence.new_zeros(())
        pairs = self.pairs.project(vertices)  # (2m, V, 3)
        depth = optical_depth(torch.cat([screen, pairs]), faces, side, self.stage.softness)
        inputs, m = len(self.views), len(pairs) // 2
        visible = rasterize(pairs[m:], faces, (side, side))
        seen, mirrored = depth[inputs : inputs + m], depth[inputs + m :]
        return depth[:inputs], losses.image_symmetry(
            seen, mirrored, visible, faces, confidence, self.config.confidence_cost
        )

    def silhouette(self, depth: Tensor) -> Tensor:
        """Cross entropy (paper), or the squared difference over an image pyramid."""
        loss = losses.silhouette_pyramid if self.config.pyramid else losses.silhouette
        return loss(depth, self.target.silhouette, self.target.known)

    def mirrored(self, vertices: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        """Symmetry confidence (V,), the network's or the best there is, and the vertex symmetry loss with it.

        Both zero for an object without a mirror plane.
        """
        if self.normal is None:
            return torch.zeros_like(confidence), confidence.new_zeros(())
        cost, mirror = self.config.confidence_cost, mirror_matrix(self.normal)
        nearest = nearest_mirrored(vertices, mirror)
        if not self.config.learn_confidence:
            distance2 = (vertices @ mirror - vertices[nearest]).square().sum(1)
            confidence = best_confidence(distance2, cost)
        return confidence, losses.vertex_symmetry(vertices, nearest, mirror, confidence, cost)

    def smoothness(self, vertices: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Normal consistency and Laplacian, weighted: of the mesh (paper), or of its change."""
        weights = self.config.weights
        if self.config.regularise_change:
            folds = losses.fold_change(vertices, self.topology, self.folds)
            smooth = losses.laplacian(offsets, neighbour_mean(offsets, self.topology))
        else:
            folds = losses.normal_consistency(vertices, self.topology)
            smooth = losses.laplacian(vertices, neighbour_mean(vertices, self.topology))
        return weights.normal_consistency * folds, weights.laplacian * smooth

    def snapshot(self, iteration: int) -> Snapshot:
        """What the next iteration depends on and `Fit(whole, config)` and `enter` do not make."""
        return {
            "iteration": iteration,
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "best": self.best.tensors,
            "iou": self.iou,
        }

    def restore(self, snapshot: Snapshot) -> None:
        """Go on after the snapshot's iteration; call it within the stage of that."""
        self.network.load_state_dict(snapshot["network"])
        self.optimiser.load_state_dict(snapshot["optimiser"])
        for now, then in zip(
            (*self.best.tensors, self.iou), (*snapshot["best"], snapshot["iou"]), strict=True
        ):
            now.copy_(then)

    def state(self) -> State:
        """The best iterate, world frame."""
        mesh = Mesh(self.frame.world(self.coarse + self.best.offsets), self.whole.mesh.faces)
        confidence = self.best.confidence
        if not self.config.learn_confidence:
            confidence = confidence_of(mesh, self.whole.plane, self.config)
        return State(
            "refined",
            mesh,
            self.whole.there,
            self.whole.plane,
            confidence,
            self.whole.camera_turn_degrees,
            best_iteration=int(self.best.at),
            loss_curve=self.loss_curve(),
        )

    def progress(self, iteration: int) -> Progress:
        """The losses of an iteration that is done. Raises Diverged when they are not finite."""
        values = self.best.curve[iteration - 1].tolist()
        if not math.isfinite(values[-1]):
            raise Diverged(f"the loss became {values[-1]} by iteration {iteration}; try another seed")
        losses_by_name = dict(zip((*TERMS, "total"), values, strict=True))
        return Progress(iteration, self.config.iterations, losses_by_name, float(self.iou))

    def loss_curve(self) -> dict[str, list[float]]:
        """Weighted terms and their total per iteration."""
        return dict(zip((*TERMS, "total"), self.best.curve.T.tolist(), strict=True))
