"""The white-box baseline moves the surface as its field moves, and so follows the silhouette."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refine_bench import white_box
from refine_bench.cases import CaseSkipped
from refine_bench.methods import make_method
from refine_bench.sets.upstream import upstream_cases
from refine_bench.upstream.network import GRID, HALF_SIDE, load_network
from refine_bench.upstream.photos import Photo
from refine_bench.upstream.reconstruct import OCCUPANCY_LEVEL, surface
from refine_engine.method.config import RefineConfig

LEVEL = float(np.log(OCCUPANCY_LEVEL / (1 - OCCUPANCY_LEVEL)))  # the logit of the surface


def ball(radius: float) -> torch.Tensor:
    """Logits (40, 40, 40) whose level set is a ball, 12 per unit of length."""
    middles = ((torch.arange(GRID) + 0.5) / GRID * 2 - 1) * HALF_SIDE
    grid = torch.stack(torch.meshgrid(middles, middles, middles, indexing="ij"), -1)
    logits: torch.Tensor = 12 * (radius - grid.norm(dim=-1)) + LEVEL
    return logits


def test_vertices_move_outwards_as_the_field_grows_as_far_as_the_surface_does() -> None:
    growth = torch.zeros((), requires_grad=True)
    mesh = surface(ball(0.3), triangles=None)
    followed = white_box._follow(mesh.vertices, ball(0.3) + growth)
    assert torch.equal(followed, mesh.vertices)
    (slope,) = torch.autograd.grad(followed.norm(dim=1).mean(), growth)
    grown = surface(ball(0.3) + 0.12, triangles=None).vertices.norm(dim=1).mean()
    assert float(slope) == pytest.approx(1 / 12, rel=0.03)
    assert 0.12 * float(slope) == pytest.approx(float(grown - mesh.vertices.norm(dim=1).mean()), rel=0.1)


def test_the_code_follows_the_silhouette_in_a_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(white_box, "PRIOR", 0.0)
    monkeypatch.setattr(white_box, "LEARNING_RATE", 0.2)
    case = next(case for case in upstream_cases(count=1, kind="camera") if case.level == "strong")
    scene = case.load()
    assert scene.image is not None
    photo = Photo(scene.image, scene.view.silhouette.numpy() > 0.5, scene.view.camera)
    mesh, curve = white_box.fine_tune(load_network("camera"), photo, iterations=8)
    assert len(curve) == 8
    assert min(curve) < 0.95 * curve[0]
    assert len(mesh.faces) <= 3000
    with pytest.raises(CaseSkipped, match="expected a network of ours"):
        make_method("white_box", RefineConfig())(case, replace(scene, image=None), 0)
