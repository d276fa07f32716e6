"""From files to a result by way of Inputs: what is read, what is refined, and the warnings on the way."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from PIL import Image
from torch import Tensor

from refine_engine.artifacts.make import make_report
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.cameras.spec import camera_from_spec
from refine_engine.checks.check import GivenPlane
from refine_engine.errors import CameraInvalid, Cancelled, InputError, SilhouetteInvalid
from refine_engine.method.config import RefineConfig, Stage, Weights
from refine_engine.method.loop import refine
from refine_engine.request import Inputs, Observation, read_inputs, read_view
from refine_engine.values import Mesh, Progress
from refine_proto.cameras import LookAtCamera
from refine_proto.checks import Checks, Code

CONFIG = RefineConfig(proportions=None, stages=(Stage(4, 32, 1e-3),), encoder_size=32)
FRONT = LookAtCamera(azimuth_degrees=60, elevation_degrees=25, distance=2.2)
BACK = LookAtCamera(azimuth_degrees=-120, elevation_degrees=10, distance=2.4)
# A long box off the origin. The last triangle of the file has no area.
CORNERS = [[x, y, z] for x in (0.0, 1.2) for y in (0.0, 0.3) for z in (0.0, 0.5)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
OBJ = "".join(
    [f"v {x} {y} {z}\n" for x, y, z in CORNERS]
    + [f"f {a + 1} {b + 1} {c + 1} {d + 1}\n" for a, b, c, d in QUADS]
    + ["f 1 1 2\n"]
).encode()


def encoded(pixels: Tensor) -> bytes:
    image = io.BytesIO()
    Image.fromarray(pixels.numpy()).save(image, "PNG")
    return image.getvalue()


def png(camera: LookAtCamera) -> bytes:
    """A box a tenth larger, as the camera sees it."""
    faces = [triangle for a, b, c, d in QUADS for triangle in ((a, b, c), (a, c, d))]
    larger = Mesh(torch.tensor(CORNERS) * 1.1, torch.tensor(faces))
    return encoded(hard_silhouette(larger, camera_from_spec(camera, 64, 64)))


def inputs() -> Inputs:
    return read_inputs(OBJ, "box.obj", png(FRONT), FRONT)


def test_warnings_about_the_files_reach_the_result_and_the_report() -> None:
    """Of the mesh (a triangle without area) and of the camera (it was written the other way round)."""
    mirrored = FRONT.model_copy(update={"azimuth_degrees": -60})
    read = read_inputs(OBJ, "box.obj", png(mirrored), FRONT)
    about_the_mesh, about_the_camera = read.warnings
    assert "1 of 13 triangles" in about_the_mesh
    assert "did you mean azimuth negated?" in about_the_camera
    assert [finding.code for finding in read.findings] == [Code.CAMERA_MISREAD]
    result = read.refine(CONFIG)
    assert result.warnings[: len(read.warnings)] == read.warnings
    assert make_report(read, result, CONFIG)["warnings"] == list(result.warnings)


def test_inputs_refine_as_the_method_does() -> None:
    """With one silhouette and with two."""
    one = inputs()
    two = replace(one, views=(*one.views, read_view(png(BACK), BACK)))
    seen: list[Progress] = []
    for read in (one, two):
        result = read.refine(CONFIG, "cpu", seen.append)
        expected = refine(read.mesh_file.mesh, read.views, CONFIG)
        assert torch.equal(result.mesh.vertices, expected.mesh.vertices)
    assert {progress.iteration for progress in seen} >= {0, 4}


def test_inputs_can_be_cancelled() -> None:
    with pytest.raises(Cancelled):
        inputs().refine(CONFIG, cancelled=lambda: True)


def test_strict_checks_refuse_what_is_a_warning_else() -> None:
    mirrored = FRONT.model_copy(update={"azimuth_degrees": -60})
    with pytest.raises(CameraInvalid, match="did you mean azimuth negated"):
        read_inputs(OBJ, "box.obj", png(mirrored), FRONT, checks=Checks.STRICT)


def test_without_checks_all_is_refined_that_can_be_drawn() -> None:
    """Even where the camera looks away: the mesh comes back, with a warning."""
    away = FRONT.model_copy(update={"azimuth_degrees": 0, "distance": 0.01})
    with pytest.raises(InputError):
        read_inputs(OBJ, "box.obj", png(FRONT), away)
    read = read_inputs(OBJ, "box.obj", png(FRONT), away, checks=Checks.OFF)
    assert (read.findings, len(read.warnings)) == ((), 1)
    result = read.refine(CONFIG)
    assert torch.isfinite(result.mesh.vertices).all()
    assert "the 2D IoU of the result is only 0.0" in result.warnings[-1]


def test_a_result_that_agrees_less_than_before_carries_a_warning() -> None:
    """Nothing holds this one to its silhouette, and smoothing makes it shrink."""
    smooth = Weights(silhouette=0, image_symmetry=0, vertex_symmetry=0, displacement=0, laplacian=100)
    config = replace(CONFIG, weights=smooth, regularise_change=False, learning_rate=0.01)
    result = inputs().refine(config)
    assert result.silhouette_iou_after < result.silhouette_iou_before
    assert f"fell from {result.silhouette_iou_before:.3f} to" in result.warnings[-1]


def test_a_given_mirror_plane_is_checked() -> None:
    askew = read_inputs(OBJ, "box.obj", png(FRONT), FRONT, symmetry=GivenPlane((1, 1, 0)))
    assert askew.findings[-1].code is Code.SYMMETRY_ELSEWHERE


def test_several_views_are_read_with_what_is_unknown_in_each() -> None:
    hidden = torch.zeros(64, 64, dtype=torch.bool)
    hidden[:, 40:] = True
    ignore = encoded(hidden)
    read = read_inputs(
        OBJ, "box.obj", png(FRONT), FRONT, more_views=[Observation(png(BACK), BACK, ignore)], ignore=ignore
    )
    for view, spec in zip(read.views, (FRONT, BACK), strict=True):
        alone = read_view(png(spec), spec, ignore=ignore)
        assert view.known is not None
        assert torch.equal(view.known, ~hidden)
        assert torch.equal(view.silhouette, alone.silhouette)
        assert torch.equal(view.camera.world_to_camera, alone.camera.world_to_camera)


def test_a_level_that_no_silhouette_has_is_said() -> None:
    read = read_inputs(OBJ, "box.obj", png(FRONT), FRONT, ignore_grey=128)
    assert read.warnings[-1] == "no pixel of a silhouette has the level 128 of ignore_grey"
    assert read_inputs(OBJ, "box.obj", png(FRONT), FRONT).warnings == read.warnings[:-1]


def test_what_is_wrong_with_a_view_names_it() -> None:
    empty = Observation(encoded(torch.zeros(64, 64, dtype=torch.bool)), BACK)
    with pytest.raises(SilhouetteInvalid, match=r"^view 2: expected an object"):
        read_inputs(OBJ, "box.obj", png(FRONT), FRONT, more_views=[empty])
    mirrored = FRONT.model_copy(update={"azimuth_degrees": -60})
    read = read_inputs(OBJ, "box.obj", png(BACK), BACK, more_views=[Observation(png(mirrored), FRONT)])
    (misread,) = (finding for finding in read.findings if finding.code is Code.CAMERA_MISREAD)
    assert misread.message.startswith("view 2: expected a camera by which")
    assert misread.message in read.warnings
