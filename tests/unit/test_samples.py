"""The committed samples are what the script makes, and what a case should be."""

import importlib.util
import json
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from refine_bench.coarsen import MILD, STRONG, coarsen, occupancy
from refine_bench.shapes import ASYMMETRIC, GENERATORS, make_shape
from refine_engine.metrics import evaluate, nearest_distances, sample_surface, silhouette_iou
from refine_engine.scene import Camera, Mesh, View
from scipy.ndimage import binary_dilation

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SAMPLES = sorted(path.name for path in (EXAMPLES / "samples").iterdir())


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_samples", EXAMPLES / "make_samples.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_samples"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def load(name: str, which: str) -> trimesh.Trimesh:
    return trimesh.load(EXAMPLES / "samples" / name / f"{which}.obj", force="mesh", process=False)


def as_mesh(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(torch.tensor(shape.vertices, dtype=torch.float32), torch.tensor(shape.faces, dtype=torch.int64))


def mask_of(folder: Path) -> np.ndarray:
    return np.asarray(Image.open(folder / "silhouette.png"))[..., 3] > 0


def largest_gap(first: trimesh.Trimesh, second: trimesh.Trimesh) -> float:
    """How far apart two surfaces are, up to the spacing of the samples."""
    clouds = [
        sample_surface(np.asarray(shape.triangles), 20_000, np.random.default_rng(0)) for shape in (first, second)
    ]
    return float(max(distances.max() for distances in nearest_distances(clouds[0], clouds[1])))


@pytest.mark.parametrize("name", SAMPLES)
def test_the_script_makes_the_committed_files(script: ModuleType, name: str, tmp_path: Path) -> None:
    script.main([name, "-o", str(tmp_path)])
    made, committed = tmp_path / name, EXAMPLES / "samples" / name
    assert {path.name for path in made.iterdir()} == {path.name for path in committed.iterdir()}
    assert json.loads((made / "camera.json").read_text()) == json.loads((committed / "camera.json").read_text())
    for which in ("gt", "coarse"):
        again = trimesh.load(made / f"{which}.obj", force="mesh", process=False)
        assert largest_gap(again, load(name, which)) < 0.03
        assert again.area == pytest.approx(load(name, which).area, rel=0.01)
    first, second = mask_of(made), mask_of(committed)
    assert (first & second).sum() / (first | second).sum() > 0.99


@pytest.mark.parametrize("name", SAMPLES)
def test_ground_truth_fills_the_silhouette_and_the_coarse_mesh_is_worse(name: str) -> None:
    folder = EXAMPLES / "samples" / name
    spec = json.loads((folder / "camera.json").read_text())
    assert spec.pop("type") == "look_at"
    silhouette = torch.from_numpy(mask_of(folder)).float()
    view = View(silhouette, Camera.look_at(**spec, width=224, height=224))
    truth, coarse = as_mesh(load(name, "gt")), as_mesh(load(name, "coarse"))
    assert silhouette_iou(truth, view) > 0.98
    assert silhouette_iou(coarse, view) < 0.9
    best, worse = evaluate(truth, truth, seeds=[0]), evaluate(coarse, truth, seeds=[0])
    assert worse.chamfer_l2 > 3 * best.chamfer_l2
    assert worse.f_score < best.f_score - 10
    assert 1400 <= len(coarse.vertices) <= 1600


@pytest.mark.parametrize("name", SAMPLES)
def test_silhouette_is_seen_from_the_camera_of_the_conventions(name: str) -> None:
    """The projection written out from docs/conventions.md (PyTorch3D's look_at), without the engine's code."""
    folder = EXAMPLES / "samples" / name
    spec, mask = json.loads((folder / "camera.json").read_text()), mask_of(folder)
    a, e = math.radians(spec["azimuth_degrees"]), math.radians(spec["elevation_degrees"])
    towards = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    points = sample_surface(np.asarray(load(name, "gt").triangles), 200_000, np.random.default_rng(0))
    depth = spec["distance"] - points @ towards
    focal = 112 / math.tan(math.radians(spec["fov_y_degrees"]) / 2)
    column = np.floor(112 + focal * (points @ right) / depth).astype(int)
    row = np.floor(112 - focal * (points @ up) / depth).astype(int)
    hit = np.zeros_like(mask)
    hit[row, column] = True
    assert not (hit & ~binary_dilation(mask, iterations=1)).any()
    assert (mask & ~binary_dilation(hit)).sum() < 0.002 * mask.sum()


def test_samples_are_small() -> None:
    assert sum(path.stat().st_size for path in (EXAMPLES / "samples").rglob("*.*")) < 1_000_000


@pytest.mark.parametrize("category", GENERATORS)
def test_shapes_are_watertight_and_symmetric_unless_said(category: str) -> None:
    for seed in range(3):
        shape = make_shape(category, seed)
        assert shape.is_watertight
        assert shape.is_winding_consistent
        assert shape.volume > 0
        assert shape.extents.max() == pytest.approx(1.0)
        mirrored = shape.copy()
        mirrored.vertices = mirrored.vertices * [1.0, 1.0, -1.0]
        mirrored.invert()
        if category in ASYMMETRIC:
            assert largest_gap(shape, mirrored) > 0.1
        else:
            assert largest_gap(shape, mirrored) < 0.03
    assert len({make_shape(category, seed).volume for seed in range(3)}) == 3  # every seed another object


def test_an_unknown_category_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a category among airplane"):
        make_shape("teapot", 0)


def test_occupancy_of_a_box_is_its_coverage() -> None:
    box = trimesh.creation.box((2.0, 1.0, 0.25))  # z covers a quarter of a cell
    cells = occupancy(box, np.array([-2.0, -1.0, -0.5]), 0.5, np.array([8, 4, 2]))
    expected = np.zeros((8, 4, 2))
    expected[2:6, 1:3, :] = 0.25
    assert np.allclose(cells, expected)
    assert cells.sum() * 0.5**3 == pytest.approx(box.volume)


def test_strong_is_worse_than_mild() -> None:
    shape = make_shape("car", 0)
    truth = as_mesh(shape)
    scores = {
        config: np.mean(
            [evaluate(as_mesh(coarsen(shape, s, config)), truth, seeds=[0]).chamfer_l2 for s in range(3)]
        )
        for config in (MILD, STRONG)
    }
    assert scores[STRONG] > 2 * scores[MILD]
