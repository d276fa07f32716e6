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
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation

from refine_bench.coarsen import MILD, STRONG, coarsen, occupancy
from refine_bench.shapes import ASYMMETRIC, GENERATORS, make_shape
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.scores.scores import chamfer_l2, nearest_distances, sample_surface
from refine_engine.values import Camera, Mesh, View

Floats = NDArray[np.float64]
EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
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


def load(name: str, which: str, folder: Path = EXAMPLES / "samples") -> trimesh.Trimesh:
    shape = trimesh.load_mesh(folder / name / f"{which}.obj", process=False)
    assert isinstance(shape, trimesh.Trimesh)
    return shape


def as_mesh(shape: trimesh.Trimesh) -> Mesh:
    vertices, faces = np.array(shape.vertices, np.float32), np.array(shape.faces, np.int64)
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


def mask_of(folder: Path) -> NDArray[np.bool_]:
    return np.asarray(Image.open(folder / "silhouette.png"))[..., 3] > 0


def distances(first: trimesh.Trimesh, second: trimesh.Trimesh) -> tuple[Floats, Floats]:
    """Between 20,000 samples of each."""
    clouds = [
        sample_surface(np.asarray(shape.triangles), 20_000, np.random.default_rng(seed))
        for seed, shape in enumerate((first, second))
    ]
    return nearest_distances(*clouds)


def coarse_error(coarse: trimesh.Trimesh, truth: trimesh.Trimesh) -> float:
    return chamfer_l2(*distances(coarse, truth))


def largest_gap(first: trimesh.Trimesh, second: trimesh.Trimesh) -> float:
    """How far apart two surfaces are, up to the spacing of the samples."""
    return float(max(way.max() for way in distances(first, second)))


@pytest.mark.parametrize("name", SAMPLES)
def test_the_script_makes_the_committed_files(script: ModuleType, name: str, tmp_path: Path) -> None:
    script.main([name, "-o", str(tmp_path)])
    made, committed = tmp_path / name, EXAMPLES / "samples" / name
    assert {path.name for path in made.iterdir()} == {path.name for path in committed.iterdir()}
    assert (made / "camera.json").read_text() == (committed / "camera.json").read_text()
    for which in ("gt", "coarse"):
        again = load(name, which, tmp_path)
        assert largest_gap(again, load(name, which)) < 0.05
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
    noise = coarse_error(load(name, "gt"), load(name, "gt"))
    assert coarse_error(load(name, "coarse"), load(name, "gt")) > 3 * noise
    assert 1400 <= len(coarse.vertices) <= 1600


@pytest.mark.parametrize("name", SAMPLES)
def test_silhouette_is_seen_from_the_camera_of_the_conventions(name: str) -> None:
    """The projection of docs/conventions.md (PyTorch3D's look_at) written out, without the engine's code."""
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
    around = np.ones((3, 3), dtype=bool)
    assert (hit & ~binary_dilation(mask, around)).sum() <= 2  # the tip of a corner, thinner than a pixel
    assert (mask & ~binary_dilation(hit, around)).sum() <= 2


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
            assert largest_gap(shape, mirrored) < 0.05
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
    mild, strong = (
        np.mean([coarse_error(coarsen(shape, seed, config), shape) for seed in range(3)])
        for config in (MILD, STRONG)
    )
    assert strong > 2 * mild
