"""How far an object is from symmetric: the criterion by which the paper selects ShapeNetAsym."""

from __future__ import annotations

import torch

from refine_engine.kernels import image_symmetry, optical_depth, rasterize
from refine_engine.method.config import RefineConfig
from refine_engine.method.views import Frame, SymmetryViews
from refine_engine.values import Mesh, MirrorPlane

ASYMMETRIC_FROM = 0.01  # "not below 0.01", with sigma = 1 and lambda_B = 1
LOSS_CONFIDENCE_COST = 1.0  # lambda_B; with sigma = 1 its term ln(1 / sigma) is 0
RENDER_SIZE = 224


def image_asymmetry(mesh: Mesh) -> float:
    """Image symmetry loss of a mesh, unweighted, with full confidence, about the plane z = 0 of its frame."""
    config = RefineConfig.paper()
    normal = mesh.vertices.new_tensor(config.symmetry_normal)
    frame = Frame.of(mesh, MirrorPlane(normal, 0.0, None))
    vertices = frame.normalise(mesh.vertices)
    pairs = SymmetryViews.of(config, RENDER_SIZE, normal).project(vertices)
    count = len(pairs) // 2
    with torch.no_grad():
        depth = optical_depth(pairs, mesh.faces, RENDER_SIZE, config.stages[-1].softness)
        visible = rasterize(pairs[count:], mesh.faces, (RENDER_SIZE, RENDER_SIZE))
        full = torch.ones(len(vertices))
        loss = image_symmetry(depth[:count], depth[count:], visible, mesh.faces, full, LOSS_CONFIDENCE_COST)
    return float(loss)
