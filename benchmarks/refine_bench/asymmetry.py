"""How far an object is from symmetric: the criterion by which the paper selects ShapeNetAsym."""

from __future__ import annotations

import torch

from refine_engine import losses
from refine_engine.cameras import project
from refine_engine.config import RefineConfig
from refine_engine.problem import Frame, symmetry_views
from refine_engine.scene import Mesh
from refine_engine.silhouette import optical_depth, rasterize

ASYMMETRIC_FROM = 0.01  # "not below 0.01", with sigma = 1 and lambda_B = 1
LOSS_CONFIDENCE_COST = 1.0  # lambda_B; with sigma = 1 its term ln(1 / sigma) is 0
RENDER_SIZE = 224


def image_asymmetry(mesh: Mesh) -> float:
    """Image symmetry loss of a mesh, unweighted, with full confidence, about the plane z = 0 of its frame."""
    config = RefineConfig.paper()
    frame = Frame.of(mesh, config)
    vertices = frame.normalise(mesh.vertices)
    cameras, reflected, intrinsics = symmetry_views(config, RENDER_SIZE, vertices.device)
    softness = config.stages[-1].softness
    screens = [project(vertices, matrices, intrinsics) for matrices in (cameras, reflected)]
    with torch.no_grad():
        seen, mirrored = (optical_depth(screen, mesh.faces, RENDER_SIZE, softness) for screen in screens)
        covered = (rasterize(screens[1], mesh.faces, (RENDER_SIZE, RENDER_SIZE)).face >= 0).float()
        loss = losses.image_symmetry(seen, mirrored, torch.ones_like(covered), covered, LOSS_CONFIDENCE_COST)
    return float(loss)
