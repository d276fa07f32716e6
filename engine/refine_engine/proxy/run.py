"""`refine` for a mesh of any number of vertices."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..cameras.seen import mean_silhouette_iou
from ..method.config import RefineConfig
from ..method.loop import Checkpoints, refine
from ..values import Mesh, Progress, Proxy, Result, View
from .carry import Carrier
from .decimate import decimate

MANY_VERTICES = 5000  # above it a proxy is optimised; docs/benchmarks.md says what both cost
PROXY_VERTICES = 1500


def refine_any_size(
    mesh: Mesh,
    views: Sequence[View],
    config: RefineConfig,
    report: Callable[[Progress], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    checkpoints: Checkpoints | None = None,
) -> Result:
    """As `refine`, but of more than MANY_VERTICES a proxy is refined, and its displacement carried back.

    `report`, checkpoints, loss curve and warnings are about the proxy, all else of the result about the mesh.
    """
    used, faces = mesh.faces.unique(return_inverse=True)
    if len(used) <= MANY_VERTICES:
        return refine(mesh, views, config, report, cancelled, checkpoints)
    started = time.monotonic()
    points = mesh.vertices[used].double().cpu().numpy()
    low, size = points.min(0), float(np.ptp(points, axis=0).max())
    unit = (points - low) / size
    carrier = Carrier.of(decimate(unit, faces.cpu().numpy(), PROXY_VERTICES), unit)
    proxy = carrier.proxy
    small = Mesh(
        torch.from_numpy(proxy.vertices * size + low).to(mesh.vertices),
        torch.from_numpy(proxy.faces).to(mesh.faces),
    )
    result = refine(small, views, config, report, cancelled, checkpoints)

    moved = carrier.displacement(result.displacement.double().cpu().numpy() / size) * size
    kept = torch.ones_like(mesh.faces[:, 0], dtype=torch.bool)
    if not result.kept_faces.all():
        of_mesh = carrier.kept(result.kept_faces.cpu().numpy(), faces.cpu().numpy())
        kept = torch.from_numpy(of_mesh).to(kept.device)
    confidence = torch.from_numpy(carrier.values(result.confidence.double().cpu().numpy()))
    displacement = torch.zeros_like(mesh.vertices)
    displacement[used] = torch.from_numpy(moved).to(mesh.vertices)
    refined = Mesh(mesh.vertices + displacement, mesh.faces[kept])
    return replace(
        result,
        mesh=refined,
        kept_faces=kept,
        displacement=displacement,
        confidence=torch.ones_like(mesh.vertices[:, 0]).index_copy(0, used, confidence.to(mesh.vertices)),
        silhouette_iou_before=mean_silhouette_iou(mesh, views),
        silhouette_iou_after=mean_silhouette_iou(refined, views),
        proxy=Proxy(len(small.vertices), len(small.faces), result.silhouette_iou_after),
        seconds=time.monotonic() - started,
    )
