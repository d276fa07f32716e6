"""Two silhouettes with what is unknown in each, through the server: the bytes that the engine alone makes."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sample import CAMERA, MESH, OPTIONS, SAMPLE, SILHOUETTE
from serve_process import Served

from refine_client import RefineClient, View
from refine_engine import (
    Camera,
    camera_from_spec,
    make_artifacts,
    make_config,
    read_camera,
    read_inputs,
    read_mesh,
)
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.request import Observation

SIDE = CAMERA | {"azimuth_degrees": CAMERA["azimuth_degrees"] + 90}
SIZE = (200, 160)


def encoded(pixels: object, kind: str) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(stream, kind)
    return stream.getvalue()


@pytest.fixture(scope="module")
def side() -> View:
    """The true shape from another side, as labels 0 and 1 in a TIFF file; its left quarter is unknown."""
    camera: Camera = camera_from_spec(read_camera(SIDE), *SIZE)
    truth = read_mesh((SAMPLE / "gt.obj").read_bytes(), "gt.obj").mesh
    seen = hard_silhouette(truth, camera).numpy()
    unknown = np.zeros(seen.shape)
    unknown[:, : SIZE[0] // 4] = 1
    return View(encoded(seen, "TIFF"), SIDE, encoded(unknown * 255, "BMP"))


@pytest.mark.parametrize("scheme", ["http", "grpc"])
def test_several_views_are_refined(scheme: str, served: Served, side: View, tmp_path: Path) -> None:
    server = served.url if scheme == "http" else f"grpc://{served.grpc_address}"
    with RefineClient(server) as client:
        refined = client.refine(MESH, SILHOUETTE, CAMERA, tmp_path, OPTIONS, views=[side])
    assert isinstance(side.silhouette, bytes)
    assert isinstance(side.ignore, bytes)
    observation = Observation(side.silhouette, read_camera(SIDE), side.ignore)
    inputs = read_inputs(
        MESH.read_bytes(), MESH.name, SILHOUETTE.read_bytes(), read_camera(CAMERA), more_views=[observation]
    )
    config = make_config(OPTIONS["preset"], OPTIONS["iterations"], OPTIONS["seed"])
    wanted = make_artifacts(inputs, inputs.refine(config), config)
    report = json.loads(refined.files["report.json"].read_bytes())
    assert [view["known"] for view in report["views"]] == [1.0, 0.75]
    assert report["views"] == json.loads(wanted["report.json"])["views"]
    for name in ("refined.glb", "preview.png"):
        assert refined.files[name].read_bytes() == wanted[name]
