"""The method: fit a network to one mesh, its silhouettes and cameras (paper, section 3).

    network -> displacement, confidence -> deform -> render -> losses -> step; keep the best; report.

`refine` is the run, `Fit` its state, `Fit.step` one iteration. A step works on tensors that were there before
it and sends nothing to the host, so that on a card it is captured in a CUDA graph (`repeatable`); the host
looks at most twice a second.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..cameras.seen import mean_silhouette_iou
from ..errors import Cancelled, Diverged
from ..kernels import optical_depth, rasterize
from ..kernels.graph import repeatable
from ..values import Mesh, Progress, Result, View
from . import losses
from .config import RefineConfig, Stage
from .distinct_patches import DistinctPatches
from .network import Refiner, initialise
from .proportions import fit_proportions
from .symmetry import mirror_error, mirror_matrix, nearest_mirrored
from .topology import Topology, neighbour_mean
from .views import Frame, SymmetryViews, Target

TERMS = ("silhouette", "image_symmetry", "vertex_symmetry", "displacement", "normal_consistency", "laplacian")
REPORT_INTERVAL_S = 0.5
WORTHWHILE_SHARE = 0.8  # of distinct patches: objects have 0.4 to 0.7, a mask of noise 1, at twice the cost


def refine(
    mesh: Mesh,
    views: Sequence[View],
    config: RefineConfig,
    report: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Result:
    """Refine a coarse mesh so that it agrees with its silhouettes and stays plausible where they say nothing.

    Mesh and views are on one device, which does the work. `report` hears of the progress at most twice a
    second and of the last iteration; `cancelled` is asked before every iteration. The same seed, device and
    number of threads give the same result. Vertices that no face uses stay where they are, with confidence 1.

    Raises:
        Cancelled: `cancelled` said so.
        Diverged: a loss became NaN or infinite.
    """
    started = time.monotonic()
    used, faces = mesh.faces.unique(return_inverse=True)
    proportioned = move_as_a_whole(Mesh(mesh.vertices[used], faces), views, config)
    fit = Fit(proportioned, views, config)
    iteration, reported = 0, -math.inf
    for stage in config.stages:
        fit.enter(stage)
        step = repeatable(fit.step, mesh.vertices.device)
        for _ in range(stage.iterations):
            if cancelled is not None and cancelled():
                raise Cancelled(f"cancelled after {iteration} of {config.iterations} iterations")
            step()
            iteration += 1
            now = time.monotonic()
            if report and (now - reported > REPORT_INTERVAL_S or iteration == config.iterations):
                report(fit.progress(iteration))
                reported = now
    refined = Mesh(mesh.vertices.index_copy(0, used, fit.refined()), mesh.faces)
    return Result(
        mesh=refined,
        displacement=refined.vertices - mesh.vertices,
        confidence=torch.ones_like(mesh.vertices[:, 0]).index_copy(0, used, fit.best_confidence),
        best_iteration=int(fit.best_iteration),
        loss_curve=fit.loss_curve(),
        silhouette_iou_before=mean_silhouette_iou(mesh, views),
        silhouette_iou_after=mean_silhouette_iou(refined, views),
        symmetry_offset=float(fit.frame.centre @ fit.frame.normal),
        seconds=time.monotonic() - started,
    )


def move_as_a_whole(mesh: Mesh, views: Sequence[View], config: RefineConfig) -> Mesh:
    """The coarse mesh with its proportions and place fitted to the silhouettes, if the config asks for it."""
    if config.proportions is None:
        return mesh
    frame = Frame.of(mesh, config)
    error = None
    if config.symmetry_offset is None:
        error = mirror_error(mesh, frame.normal)(float(frame.centre @ frame.normal)) / frame.scale
    target = Target.of(views, frame, config.proportions.render_size)
    moved = fit_proportions(
        frame.normalise(mesh.vertices), mesh.faces, target, frame.normal, error, config.proportions
    )
    return Mesh(moved * frame.scale + frame.centre, mesh.faces)


class Fit:
    """One run: what is fixed, the network, the optimiser, and the best iterate of the stage so far."""

    def __init__(self, mesh: Mesh, views: Sequence[View], config: RefineConfig) -> None:
        self.config, self.views = config, views
        self.frame = Frame.of(mesh, config)
        self.coarse = self.frame.normalise(mesh.vertices)  # (V, 3)
        self.topology = Topology.of(mesh.faces, len(mesh.vertices))
        self.mirror = mirror_matrix(self.frame.normal)

        seen = Target.of(views[:1], self.frame, config.encoder_size)
        self.seen = seen.silhouette[:, None]  # (1, 1, N, N): the encoder looks at the first view
        self.grid = (seen.project(self.coarse)[..., :2] * 2 / seen.side - 1)[:, None]  # (1, 1, V, 2)
        with torch.device("meta"):  # `initialise` draws all weights: leave torch's own generator alone
            network = Refiner()
        network.to_empty(device="cpu")
        initialise(network, float(self.topology.degree.mean()), torch.Generator().manual_seed(config.seed))
        self.network = network.to(self.coarse.device)
        on_card = self.coarse.is_cuda
        if not on_card:
            network.encoder.store_channels_last()
        if config.train_encoder:
            self.features = self._features_of_the_weights()
        else:
            network.encoder.requires_grad_(False)
            constant = network.features(self.seen, self.grid)
            self.features = lambda: constant
        trained = [p for p in network.parameters() if p.requires_grad]
        self.optimiser = torch.optim.Adam(trained, config.learning_rate, fused=True, capturable=on_card)

        self.iteration = self.coarse.new_zeros(1, dtype=torch.int64)
        self.curve = self.coarse.new_zeros(config.iterations, len(TERMS) + 1)  # weighted terms, total
        self.iou = self.coarse.new_zeros(())
        self.best_total = self.coarse.new_full((), math.inf)
        self.best_offsets = torch.zeros_like(self.coarse)
        self.best_confidence = torch.ones_like(self.coarse[:, 0])
        self.best_iteration = torch.zeros_like(self.iteration)

    def _features_of_the_weights(self) -> Callable[[], Tensor]:
        """(V, 192) from the encoder's weights as they are then."""
        if not self.coarse.is_cuda:
            distinct = DistinctPatches(self.seen, self.grid)
            if distinct.share < WORTHWHILE_SHARE:
                return lambda: distinct.features(self.network.encoder)
        return lambda: self.network.features(self.seen, self.grid)

    def enter(self, stage: Stage) -> None:
        """Totals of different stages do not compare: the best iterate is the best of the last one."""
        self.stage = stage
        self.target = Target.of(self.views, self.frame, stage.render_size)
        self.pairs = SymmetryViews.of(self.config, stage.render_size, self.frame.normal)
        self.best_total.fill_(math.inf)

    def step(self) -> None:
        """One iteration."""
        offsets, confidence = self.network(self.features(), self.coarse, self.topology)
        vertices = self.coarse + offsets
        depth, image_symmetry_loss = self.render(vertices, confidence)
        nearest = nearest_mirrored(vertices, self.mirror)
        cost, weights = self.config.confidence_cost, self.config.weights
        terms = torch.stack(
            [
                weights.silhouette * losses.silhouette(depth, self.target.silhouette, self.target.known),
                weights.image_symmetry * image_symmetry_loss,
                weights.vertex_symmetry
                * losses.vertex_symmetry(vertices, nearest, self.mirror, confidence, cost),
                weights.displacement * losses.displacement(offsets),
                weights.normal_consistency * losses.normal_consistency(vertices, self.topology),
                weights.laplacian * losses.laplacian(vertices, neighbour_mean(vertices, self.topology)),
            ]
        )
        total = terms.sum()
        self.optimiser.zero_grad()
        total.backward()
        self.optimiser.step()
        self.keep(terms.detach(), total.detach(), offsets.detach(), confidence.detach(), depth.detach())

    def render(self, vertices: Tensor, confidence: Tensor) -> tuple[Tensor, Tensor]:
        """Optical depth at the input cameras (B, N, N), and the image symmetry loss of the view pairs."""
        faces, side = self.topology.faces, self.stage.render_size
        pairs = self.pairs.project(vertices)  # (2m, V, 3)
        screen = torch.cat([self.target.project(vertices), pairs])
        depth = optical_depth(screen, faces, side, self.stage.softness)
        inputs, m = len(self.views), len(pairs) // 2
        visible = rasterize(pairs[m:], faces, (side, side))
        seen, mirrored = depth[inputs : inputs + m], depth[inputs + m :]
        return depth[:inputs], losses.image_symmetry(
            seen, mirrored, visible, faces, confidence, self.config.confidence_cost
        )

    def keep(self, terms: Tensor, total: Tensor, offsets: Tensor, confidence: Tensor, depth: Tensor) -> None:
        """Write the loss curve, and remember this iterate if it is the best of its stage."""
        self.curve.index_copy_(0, self.iteration, torch.cat([terms, total[None]])[None])
        self.iteration += 1
        better = total < self.best_total
        for best, now in (
            (self.best_total, total),
            (self.best_offsets, offsets),
            (self.best_confidence, confidence),
            (self.best_iteration, self.iteration),
        ):
            torch.where(better, now, best, out=best)
        covered, wanted = depth > math.log(2), self.target.silhouette > 0.5
        torch.div((covered & wanted).sum(), (covered | wanted).sum(), out=self.iou)

    def progress(self, iteration: int) -> Progress:
        """The losses of an iteration that is done. Raises Diverged when they are not finite."""
        values = self.curve[iteration - 1].tolist()
        if not math.isfinite(values[-1]):
            raise Diverged(f"the loss became {values[-1]} by iteration {iteration}; try another seed")
        losses_by_name = dict(zip((*TERMS, "total"), values, strict=True))
        return Progress(iteration, self.config.iterations, losses_by_name, float(self.iou))

    def refined(self) -> Tensor:
        """The best iterate's vertices (V, 3), world units. Raises Diverged when no loss was finite."""
        self.progress(self.config.iterations)
        return (self.coarse + self.best_offsets) * self.frame.scale + self.frame.centre

    def loss_curve(self) -> dict[str, list[float]]:
        """Weighted terms and their total per iteration."""
        return dict(zip((*TERMS, "total"), self.curve.T.tolist(), strict=True))
