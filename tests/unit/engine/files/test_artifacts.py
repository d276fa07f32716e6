from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from refine_engine.artifacts.make import make_artifacts
from refine_engine.artifacts.pictures import hard_render
from refine_engine.files import gltf
from refine_engine.files.colour_scale import confidence_colours
from refine_engine.files.mesh_file import read_mesh
from refine_engine.method.config import RefineConfig
from refine_engine.request import Inputs
from refine_engine.values import Camera, Mesh, MirrorPlane, Result, View
from refine_proto.formats import ARTIFACTS

WIDTH, HEIGHT = 120, 80


@pytest.fixture
def artifacts(textured: bytes) -> dict[str, Any]:
    """Artifacts of a cube that was made a little smaller; its right half is confident, its left half not."""
    file = read_mesh(textured, "a.glb")
    centre = file.mesh.vertices.mean(0)
    world_to_camera = torch.eye(4)
    world_to_camera[:3, 3] = torch.tensor([0.0, 0.0, 12.0]) - centre
    camera = Camera(world_to_camera, 90.0, 90.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    silhouette = (hard_render(file.mesh, camera).face[0] >= 0).float()
    view = View(silhouette, camera)
    refined = Mesh(centre + 0.9 * (file.mesh.vertices - centre), file.mesh.faces)
    confidence = (file.mesh.vertices[:, 0] > centre[0]).float()
    moved = refined.vertices - file.mesh.vertices
    curve = {"total": [2.0, 1.0]}
    result = Result(
        mesh=refined,
        kept_faces=torch.ones(12, dtype=torch.bool),
        displacement=moved,
        confidence=confidence,
        best_iteration=7,
        loss_curve=curve,
        silhouette_iou_before=0.9,
        silhouette_iou_after=0.8,
        outcome="refined",
        plane=MirrorPlane(torch.tensor([0.0, 0.0, 1.0]), 0.25, 0.01),
        camera_turn_degrees=1.5,
        seconds=1.5,
        warnings=("slow",),
    )
    made: dict[str, Any] = dict(make_artifacts(Inputs(file, (view,), ()), result, RefineConfig()))
    return {"file": file, "view": view, "result": result} | made


def test_names_are_the_contract(artifacts: dict[str, Any]) -> None:
    assert [name for name in artifacts if name in ARTIFACTS] == list(ARTIFACTS)
    torch.testing.assert_close(
        read_mesh(artifacts["refined.glb"], "a.glb").mesh.vertices,
        artifacts["result"].mesh.vertices,
        rtol=0,
        atol=1e-5,
    )


def test_confidence_png_lies_over_the_input_image(artifacts: dict[str, Any]) -> None:
    picture = np.asarray(Image.open(io.BytesIO(artifacts["confidence.png"]))).astype(int)
    assert picture.shape[1:] == (WIDTH, 4)
    seen = picture[:HEIGHT]
    covered = (hard_render(artifacts["result"].mesh, artifacts["view"].camera).face[0] >= 0).numpy()
    assert np.array_equal(seen[..., 3] == 255, covered)
    assert (seen[~covered][:, 3] == 0).all()
    rows, columns = np.nonzero(covered)
    pixels, edge = seen[rows, columns], np.quantile(columns, (0.1, 0.9))
    left, right = pixels[columns < edge[0]], pixels[columns > edge[1]]
    low, high = (confidence_colours(np.array(end)) * 255 for end in (0.0, 1.0))
    assert abs(left[:, :3].mean(0) - low).max() < 40
    assert abs(right[:, :3].mean(0) - high).max() < 40


def test_confidence_png_and_glb_show_the_same_colours(artifacts: dict[str, Any]) -> None:
    """The legend's ends are the colours of confidence 0 and 1 in the GLB."""
    picture = np.asarray(Image.open(io.BytesIO(artifacts["confidence.png"])))
    document = gltf.parse(artifacts["confidence.glb"])
    linear = document.read(document.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])[:, :3]
    shown = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
    for legend in (picture[HEIGHT + 10, 8, :3], picture[HEIGHT + 10, WIDTH - 9, :3]):
        assert abs(shown - legend).max(1).min() < 1


def test_confidence_npz_has_vertices_and_symmetry_views(artifacts: dict[str, Any]) -> None:
    arrays = np.load(io.BytesIO(artifacts["confidence.npz"]))
    file = artifacts["file"]
    assert np.array_equal(arrays["vertex"], artifacts["result"].confidence)
    assert np.array_equal(arrays["source_vertex"], arrays["vertex"][file.vertex_of_source])
    views = arrays["views"]
    assert views.shape == (12, 224, 224)
    assert arrays["world_to_camera"].shape == (12, 4, 4)
    for picture in views:
        seen = picture[np.isfinite(picture)]
        assert 0.05 < len(seen) / picture.size < 0.9
        assert seen.min() >= 0
        assert seen.max() <= 1 + 1e-6
        assert seen.std() > 0.1  # both halves are in view


def test_confidence_npz_has_what_was_refined(artifacts: dict[str, Any]) -> None:
    arrays = np.load(io.BytesIO(artifacts["confidence.npz"]))
    coarse, view = artifacts["file"].mesh, artifacts["view"]
    assert np.array_equal(arrays["coarse_vertices"], coarse.vertices)
    assert np.array_equal(arrays["coarse_faces"], coarse.faces)
    assert np.array_equal(arrays["silhouette"], view.silhouette)
    assert np.array_equal(arrays["silhouette_camera"], view.camera.world_to_camera)
    assert arrays["silhouette_intrinsics"].tolist() == [90, 90, WIDTH / 2, HEIGHT / 2]
    assert not arrays["silhouette_orthographic"]


def test_preview_shows_four_panels_in_two_rows(artifacts: dict[str, Any]) -> None:
    picture = np.asarray(Image.open(io.BytesIO(artifacts["preview.png"]))).astype(int)
    height, width = picture.shape[:2]
    panels = picture.reshape(2, height // 2, 4, width // 4, 3).transpose(0, 2, 1, 3, 4)
    for row in panels:
        for panel in row:
            assert 0.02 < (abs(panel - 255).sum(-1) > 30).mean() < 0.9  # neither empty nor full
    shaded = panels[0, 1, 40:-40, 40:-40]
    assert len(np.unique(shaded[..., 2])) >= 2  # faces in several shades
    overlay = panels[0, 3].reshape(-1, 3)
    for colour in ((0, 140, 51), (26, 64, 230)):  # input and after; before hides behind the input
        assert (abs(overlay - colour).sum(1) < 60).any()


def test_report_json_says_what_was_done(artifacts: dict[str, Any]) -> None:
    report = json.loads(artifacts["report.json"])
    assert report["silhouette_iou"] == {"before": 0.9, "after": 0.8}
    assert report["config"]["weights"]["silhouette"] == RefineConfig().weights.silhouette
    assert report["mesh_counts"] == {
        "vertices": 8,
        "faces": 12,
        "source_vertices": 24,
        "optimised_vertices": 8,
        "optimised_faces": 12,
        "refined_vertices": 8,
        "refined_faces": 12,
        "removed_faces": 0,
    }
    assert report["outcome"] == "refined"
    assert report["mirror_plane"] == {"normal": [0.0, 0.0, 1.0], "offset": 0.25, "error": pytest.approx(0.01)}
    assert report["camera_correction"] == {"turn_degrees": 1.5}
    assert report["loss_curve"] == {"total": [2.0, 1.0]}
    assert report["warnings"] == ["slow"]
    assert torch.__version__.startswith(report["versions"]["torch"])  # it may end in +cu130 or +cpu
