"""A mesh seen by cameras: the points that the pixels show, and the same scene in other units and places."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from refine_engine import read_inputs
from refine_engine.artifacts.pictures import draw_preview
from refine_engine.cameras.seen import hard_silhouette, seen_by, silhouette_iou
from refine_engine.cameras.spec import read_camera
from refine_engine.commands.evaluate import eval_command
from refine_engine.kernels import interpolate
from refine_engine.values import Camera, Mesh, Projection, View
from refine_proto.cameras import CameraSpec

SIDE, FOV_DEGREES = 64, 35.0
UNITS = pytest.mark.parametrize("unit", [1000.0, 0.004, 0.001])  # millimetres; nearer than 0.01; kilometres
PROJECTIONS = pytest.mark.parametrize("projection", ["perspective", "orthographic"])
VERTICES = torch.tensor([[0.5, 0, 0], [-0.3, 0, 0], [0, 0.4, 0], [0, -0.3, 0], [0, 0, 0.4], [0, 0, -0.4]])
FACES = torch.tensor([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])


def mesh_in(unit: float) -> Mesh:
    """A lopsided octahedron of 0.8 lengths, each so many units long."""
    return Mesh(VERTICES * unit, FACES)


def camera_in(unit: float, projection: Projection) -> Camera:
    """1.9 lengths from the origin."""
    camera = Camera.look_at(30, 20, 1.9 * unit, FOV_DEGREES, SIDE, SIDE)
    if projection == "perspective":
        return camera
    return replace(camera, fx=60 / unit, fy=50 / unit, projection="orthographic")


@PROJECTIONS
def test_a_pixel_shows_the_point_that_is_projected_to_it(projection: Projection) -> None:
    """Also inside a face, where only the right weights of its corners give the right point."""
    mesh, camera = mesh_in(1.0), camera_in(1.0, projection)
    fragments = seen_by(mesh, [camera])
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    corners = mesh.vertices @ rotation.T + translation  # camera axes
    x, y, z = (interpolate(fragments, mesh.faces, corners[:, axis].contiguous())[0] for axis in range(3))
    scale: Tensor | float = z if projection == "perspective" else 1.0
    covered = fragments.face[0] >= 0
    assert int(covered.sum()) > 500
    row, column = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    for centre, shown in (
        (column, camera.fx * x / scale + camera.cx),
        (row, camera.fy * y / scale + camera.cy),
    ):
        torch.testing.assert_close(shown[covered], centre[covered], rtol=0, atol=1e-3)


@UNITS
@PROJECTIONS
def test_units_do_not_matter_to_what_is_seen(unit: float, projection: Projection) -> None:
    expected = hard_silhouette(mesh_in(1.0), camera_in(1.0, projection))
    camera = camera_in(unit, projection)
    assert int(expected.sum()) > 500
    assert torch.equal(hard_silhouette(mesh_in(unit), camera), expected)
    assert silhouette_iou(mesh_in(unit), View(expected.float(), camera)) == 1.0


@PROJECTIONS
def test_place_does_not_matter_to_what_is_seen(projection: Projection) -> None:
    camera, shift = camera_in(1.0, projection), torch.tensor([7.0, -5.0, 3.0])
    matrix = camera.world_to_camera.clone()
    matrix[:3, 3] -= matrix[:3, :3] @ shift
    moved = Mesh(VERTICES + shift, FACES)
    seen, expected = hard_silhouette(moved, replace(camera, world_to_camera=matrix)), mesh_in(1.0)
    assert int((seen != hard_silhouette(expected, camera)).sum()) <= 2  # rounding of the moved vertices


@UNITS
@PROJECTIONS
def test_units_do_not_matter_to_the_preview(unit: float, projection: Projection) -> None:
    silhouette = hard_silhouette(mesh_in(1.0), camera_in(1.0, projection)).float()

    def preview(unit: float) -> Tensor:
        mesh, view = mesh_in(unit), View(silhouette, camera_in(unit, projection))
        thinner = Mesh(mesh.vertices * torch.tensor([0.8, 1.0, 1.0]), FACES)
        picture = Image.open(
            io.BytesIO(draw_preview([view], thinner, mesh, torch.linspace(0, 1, len(VERTICES))))
        )
        return torch.from_numpy(np.array(picture)).float()

    difference = (preview(unit) - preview(1.0)).abs()
    assert float((difference > 2).float().mean()) < 1e-3  # rounding may move a pixel of an outline


def files_in(unit: float) -> tuple[bytes, bytes, CameraSpec]:
    """The mesh as OBJ, its silhouette as PNG, its camera as a spec."""
    lines = [f"v {x} {y} {z}" for x, y, z in mesh_in(unit).vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (FACES + 1).tolist()]
    covered = hard_silhouette(mesh_in(1.0), camera_in(1.0, "perspective"))
    png = io.BytesIO()
    Image.fromarray((covered.numpy() * 255).astype("uint8")).save(png, "PNG")
    spec = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.9 * unit}
    spec |= {"fov_y_degrees": FOV_DEGREES}
    return "\n".join(lines).encode(), png.getvalue(), read_camera(spec)


@UNITS
def test_units_do_not_matter_to_a_request(unit: float) -> None:
    mesh, silhouette, camera = files_in(unit)
    inputs = read_inputs(mesh, "mesh.obj", silhouette, camera)
    assert inputs.warnings == ()
    assert silhouette_iou(inputs.mesh_file.mesh, inputs.views[0]) == 1.0


@UNITS
def test_units_do_not_matter_to_eval(unit: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh, silhouette, camera = files_in(unit)
    for name, content in (
        ("m.obj", mesh),
        ("s.png", silhouette),
        ("c.json", camera.model_dump_json().encode()),
    ):
        (tmp_path / name).write_bytes(content)
    path: Callable[[str], str] = lambda name: str(tmp_path / name)  # noqa: E731
    view = ["--camera", path("c.json"), "--silhouette", path("s.png")]
    assert eval_command([path("m.obj"), path("m.obj"), *view, "--seeds", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["predicted"]["silhouette_iou"] == 1.0


def test_the_iou_counts_known_pixels_only() -> None:
    mesh, camera = mesh_in(1.0), camera_in(1.0, "perspective")
    seen = hard_silhouette(mesh, camera)
    left = torch.arange(SIDE).expand(SIDE, SIDE) < SIDE // 2
    hidden = View((seen & left).float(), camera, left)
    assert silhouette_iou(mesh, hidden) == 1.0
    assert silhouette_iou(mesh, replace(hidden, known=None)) < 0.7
    wrong_where_known = View((seen & left).float(), camera, ~left | ~seen | (torch.rand(SIDE, SIDE) < 0.5))
    assert silhouette_iou(mesh, wrong_where_known) < 0.7
