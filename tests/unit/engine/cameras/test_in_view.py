"""The check that the camera sees the object, on a lopsided box and its own picture."""

from collections.abc import Mapping

import pytest
import torch

from refine_engine.cameras.in_view import check_in_view
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.cameras.spec import AXES, camera_from_spec, read_camera
from refine_engine.errors import ObjectOutOfView
from refine_engine.values import Camera, Mesh, View

WIDTH, HEIGHT = 96, 64
LOOK_AT = {"type": "look_at", "azimuth_degrees": 60, "elevation_degrees": 25, "distance": 2.2}


def box() -> Mesh:
    """A long box off the origin, so that no two cameras see it alike: x 0..1.2, y 0..0.3, z 0..0.5."""
    corners = [[x, y, z] for x in (0.0, 1.2) for y in (0.0, 0.3) for z in (0.0, 0.5)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return Mesh(torch.tensor(corners), torch.tensor(faces))


def camera_of(spec: Mapping[str, object], width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return camera_from_spec(read_camera(spec), width, height)


def picture(camera: Camera) -> torch.Tensor:
    return hard_silhouette(box(), camera).float()


def opengl_camera_to_world(camera: Camera) -> list[list[float]]:
    matrix = torch.tensor(AXES["opengl"])[:, None] * camera.world_to_camera
    rows: list[list[float]] = torch.linalg.inv(matrix).tolist()
    return rows


def test_the_true_camera_is_fine() -> None:
    camera = camera_of(LOOK_AT)
    assert check_in_view(box(), View(picture(camera), camera), read_camera(LOOK_AT)) is None


def test_a_large_image_is_judged_the_same() -> None:
    camera = camera_of(LOOK_AT, 960, 640)
    assert check_in_view(box(), View(picture(camera), camera), read_camera(LOOK_AT)) is None


def test_behind_the_camera_names_the_convention_that_fits() -> None:
    true = camera_of(LOOK_AT)
    spec = {
        "type": "matrix",
        "convention": "opencv",
        "camera_to_world": opengl_camera_to_world(true),
        "fov_y_degrees": 60,
    }
    view = View(picture(true), camera_of(spec))
    with pytest.raises(ObjectOutOfView) as error:
        check_in_view(box(), view, read_camera(spec))
    assert str(error.value) == (
        "expected the object in the image, got one that is entirely behind the camera; "
        "did you mean convention opengl, camera_to_world? it gives a 2D IoU of 1.00"
    )


def test_outside_the_image_without_a_better_reading() -> None:
    true = camera_of(LOOK_AT)
    intrinsics = {"fx": 1000, "fy": 1000, "cx": -5000, "cy": 32}
    spec = {
        "type": "matrix",
        "convention": "opengl",
        "camera_to_world": opengl_camera_to_world(true),
        "intrinsics": intrinsics,
    }
    view = View(picture(true), camera_of(spec))
    with pytest.raises(ObjectOutOfView) as error:
        check_in_view(box(), view, read_camera(spec))
    assert str(error.value) == "expected the object in the image, got one that lies outside the 96x64 pixels"


def test_a_camera_inside_the_object_is_told() -> None:
    """In front of this one's plane is only the corner at the origin, and no face as a whole."""
    spec = {**LOOK_AT, "azimuth_degrees": 45, "elevation_degrees": 35, "distance": 0.1}
    view = View(picture(camera_of(LOOK_AT)), camera_of(spec))
    with pytest.raises(ObjectOutOfView) as error:
        check_in_view(box(), view, read_camera(spec))
    assert str(error.value).startswith(
        "expected the object in the image, got one around the camera, from depth -"
    )


def test_in_the_image_but_in_the_wrong_place_is_a_warning() -> None:
    true = camera_of({**LOOK_AT, "azimuth_degrees": -60})
    view = View(picture(true), camera_of(LOOK_AT))
    warning = check_in_view(box(), view, read_camera(LOOK_AT))
    assert warning is not None
    assert "did you mean azimuth_degrees negated? it gives a 2D IoU of 1.00" in warning
