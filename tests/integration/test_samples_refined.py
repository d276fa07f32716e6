"""The fast preset on two of the committed samples: nearer to the ground truth, and to the silhouette."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from refine_engine.cameras.spec import read_camera
from refine_engine.method.config import RefineConfig
from refine_engine.request import read_inputs
from refine_engine.scores.scores import chamfer_l2, nearest_distances, sample_surface
from refine_engine.values import Mesh

SAMPLES = Path(__file__).resolve().parents[2] / "examples" / "samples"


def chamfer_to(truth: trimesh.Trimesh, mesh: Mesh) -> float:
    triangles = mesh.vertices.double()[mesh.faces].numpy()
    clouds = [
        sample_surface(surface, 10_000, np.random.default_rng(seed))
        for seed, surface in enumerate((triangles, np.asarray(truth.triangles)))
    ]
    return chamfer_l2(*nearest_distances(*clouds))


@pytest.mark.parametrize("name", ["airplane", "table"])
def test_fast_preset_improves_a_sample(name: str) -> None:
    folder = SAMPLES / name
    camera = read_camera((folder / "camera.json").read_bytes())
    inputs = read_inputs(
        (folder / "coarse.obj").read_bytes(), "coarse.obj", (folder / "silhouette.png").read_bytes(), camera
    )
    truth = trimesh.load_mesh(folder / "gt.obj", process=False)
    result = inputs.refine(RefineConfig.fast())
    before, after = (chamfer_to(truth, mesh) for mesh in (inputs.mesh_file.mesh, result.mesh))
    print(
        f"{name}: Chamfer-l2 {before:.2f} -> {after:.2f}, "
        f"2D IoU {result.silhouette_iou_before:.3f} -> {result.silhouette_iou_after:.3f}"
    )
    assert after < 0.9 * before
    assert result.silhouette_iou_after > result.silhouette_iou_before + 0.05
    assert torch.isfinite(result.confidence).all()
