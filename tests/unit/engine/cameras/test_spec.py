"""Every way to write a camera, checked on pixels computed by hand."""

import json
import math
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from refine_engine.cameras.project import project
from refine_engine.cameras.spec import AXES, camera_from_spec, other_conventions, read_camera
from refine_engine.errors import CameraInvalid
from refine_engine.values import Camera

WIDTH, HEIGHT = 200, 100
LOOK_AT = {
    "type": "look_at",
    "azimuth_degrees": 0,
    "elevation_degrees": 0,
    "distance": 2,
    "fov_y_degrees": 90,
}
INTRINSICS = {"fx": 50, "fy": 50, "cx": 100, "cy": 50}

# The camera of LOOK_AT, at (0, 0, 2) facing -Z, written out in the six usual ways.
FRONT = {
    ("opencv", "world_to_camera"): [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]],
    ("opencv", "camera_to_world"): [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]],
    ("opengl", "world_to_camera"): [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]],
    ("opengl", "camera_to_world"): [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]],
    ("pytorch3d", "world_to_camera"): [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]],
    ("pytorch3d", "camera_to_world"): [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]],
}


def matrix_spec(convention: str, direction: str, matrix: object, **lens: object) -> dict[str, object]:
    return {
        "type": "matrix",
        "convention": convention,
        direction: matrix,
        **(lens or {"intrinsics": INTRINSICS}),
    }


def pixel(camera: Camera, *point: float) -> list[float]:
    """x, y in pixels and the depth of one world point, to a thousandth."""
    intrinsics = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]])
    orthographic = camera.projection == "orthographic"
    screen = project(
        torch.tensor([point], dtype=torch.float32),
        camera.world_to_camera[None],
        intrinsics,
        orthographic=orthographic,
    )
    return [round(value, 3) for value in screen[0, 0].tolist()]


@pytest.mark.parametrize(
    ("azimuth", "elevation", "point", "expected"),
    [
        (0, 0, (0, 0, 0), [100, 50, 2]),  # the origin is in the middle, at the camera's distance
        (0, 0, (1, 0, 0), [125, 50, 2]),  # +X right: 100 + 50 * 1 / 2
        (0, 0, (0, 1, 0), [100, 25, 2]),  # +Y up is a smaller row
        (0, 0, (1, 0, 1), [150, 50, 1]),  # towards the camera: twice as far from the middle
        (90, 0, (0, 0, -1), [125, 50, 2]),  # from +X, -Z is on the right
        (90, 0, (1, 1, 0), [100, 0, 1]),
        (180, 0, (1, 0, 0), [75, 50, 2]),
        (0, 90, (0, 0, 1), [100, 75, 2]),  # from above, +Z (the front) is at the bottom
        (0, 90, (1, 0, 0), [125, 50, 2]),
        (0, -90, (0, 0, 1), [100, 25, 2]),  # from below, at the top
        (90, 90, (1, 0, 0), [100, 75, 2]),
    ],
)
def test_look_at(azimuth: float, elevation: float, point: tuple[float, ...], expected: list[float]) -> None:
    spec = {**LOOK_AT, "azimuth_degrees": azimuth, "elevation_degrees": elevation}
    assert pixel(camera_from_spec(spec, WIDTH, HEIGHT), *point) == expected


def test_look_at_stands_where_the_convention_says() -> None:
    spec = {**LOOK_AT, "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 3}
    camera = camera_from_spec(spec, WIDTH, HEIGHT)
    a, e = math.radians(30), math.radians(20)
    position = torch.tensor([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)]) * 3
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    torch.testing.assert_close(-rotation.T @ translation, position)


def test_look_at_fov_defaults_to_60_degrees() -> None:
    spec = {name: value for name, value in LOOK_AT.items() if name != "fov_y_degrees"}
    assert camera_from_spec(spec, WIDTH, HEIGHT).fx == pytest.approx(50 / math.tan(math.radians(30)))


@pytest.mark.parametrize(("convention", "direction"), FRONT)
@pytest.mark.parametrize("lens", [{"intrinsics": INTRINSICS}, {"fov_y_degrees": 90}])
def test_every_convention_gives_the_same_pixels(
    convention: str, direction: str, lens: dict[str, object]
) -> None:
    spec = matrix_spec(convention, direction, FRONT[convention, direction], **lens)
    camera = camera_from_spec(spec, WIDTH, HEIGHT)
    assert pixel(camera, 1, 0, 1) == [150, 50, 1]
    assert pixel(camera, 0, 1, 0) == [100, 25, 2]


@pytest.mark.parametrize(("convention", "axes"), AXES.items())
def test_every_convention_agrees_from_the_side(convention: str, axes: tuple[float, ...]) -> None:
    expected = camera_from_spec({**LOOK_AT, "azimuth_degrees": 70, "elevation_degrees": 35}, WIDTH, HEIGHT)
    matrix = torch.tensor(axes)[:, None] * expected.world_to_camera
    for direction, rows in (("world_to_camera", matrix), ("camera_to_world", torch.linalg.inv(matrix))):
        spec = matrix_spec(convention, direction, rows.tolist())
        given = camera_from_spec(spec, WIDTH, HEIGHT)
        torch.testing.assert_close(given.world_to_camera, expected.world_to_camera)


def test_unequal_intrinsics_on_a_tall_image() -> None:
    intrinsics = {"fx": 30, "fy": 40, "cx": 10, "cy": 70}
    spec = matrix_spec("opengl", "camera_to_world", FRONT["opengl", "camera_to_world"], intrinsics=intrinsics)
    assert pixel(camera_from_spec(spec, 80, 160), 1, 1, 0) == [10 + 15, 70 - 20, 2]


def test_orthographic_ignores_the_depth() -> None:
    intrinsics = {"fx": 25, "fy": 25, "cx": 100, "cy": 50}
    spec = matrix_spec("opengl", "camera_to_world", FRONT["opengl", "camera_to_world"], intrinsics=intrinsics)
    camera = camera_from_spec({**spec, "projection": "orthographic"}, WIDTH, HEIGHT)
    assert pixel(camera, 1, 1, 0)[:2] == [125, 25]
    assert pixel(camera, 1, 1, 1)[:2] == [125, 25]


def test_sixteen_numbers_are_four_rows() -> None:
    rows = FRONT["opengl", "world_to_camera"]
    flat = matrix_spec("opengl", "world_to_camera", [cell for row in rows for cell in row])
    assert pixel(camera_from_spec(flat, WIDTH, HEIGHT), 1, 0, 1) == [150, 50, 1]


def test_intrinsics_may_say_their_size() -> None:
    intrinsics = {**INTRINSICS, "width": WIDTH, "height": HEIGHT}
    spec = matrix_spec("opengl", "world_to_camera", FRONT["opengl", "world_to_camera"], intrinsics=intrinsics)
    assert camera_from_spec(spec, WIDTH, HEIGHT).cx == 100


GOOD_MATRIX = FRONT["opengl", "camera_to_world"]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({}, "expected type to be one of look_at, matrix, got none"),
        ({"type": "lookat"}, "got 'lookat'; did you mean look_at?"),
        ({**LOOK_AT, "azimut_degrees": 1}, "got 'azimut_degrees'; did you mean azimuth_degrees?"),
        ({"type": "look_at", "azimuth_degrees": 1}, "expected elevation_degrees, got only 'type'"),
        ({**LOOK_AT, "elevation_degrees": 91}, "expected elevation_degrees between -90 and 90, got 91"),
        ({**LOOK_AT, "distance": 0}, "expected distance above 0, got 0"),
        ({**LOOK_AT, "distance": True}, "expected distance to be a finite number, got True"),
        ({**LOOK_AT, "distance": math.nan}, "expected distance to be a finite number, got nan"),
        ({**LOOK_AT, "distance": 10**400}, "expected distance to be a finite number, got 1000"),
        ({**LOOK_AT, "fov_y_degrees": 180}, "expected fov_y_degrees between 0 and 180, got 180"),
        (
            matrix_spec("opengl", "camera_to_world", GOOD_MATRIX, fov_y_degrees=60)
            | {"projection": "orthographic"},
            "expected intrinsics for an orthographic camera, got fov_y_degrees",
        ),
        (
            matrix_spec(
                "opengl",
                "camera_to_world",
                GOOD_MATRIX,
                intrinsics=INTRINSICS | {"width": 100, "height": 200},
            ),
            "expected intrinsics for the silhouette's 200x100 pixels, got some for 100x200",
        ),
        ({"type": "matrix", "convention": "OpenGL"}, "got 'OpenGL'; did you mean opengl?"),
        (matrix_spec("opengl", "camera_to_word", GOOD_MATRIX), "did you mean camera_to_world?"),
        (
            {"type": "matrix", "convention": "opengl", "intrinsics": INTRINSICS},
            "expected exactly one of world_to_camera, camera_to_world, got none of them",
        ),
        (
            matrix_spec("opengl", "camera_to_world", GOOD_MATRIX) | {"world_to_camera": GOOD_MATRIX},
            "got world_to_camera and camera_to_world",
        ),
        (
            matrix_spec("opengl", "camera_to_world", GOOD_MATRIX) | {"fov_y_degrees": 40},
            "expected exactly one of intrinsics, fov_y_degrees, got intrinsics and fov_y_degrees",
        ),
        (
            matrix_spec("opengl", "camera_to_world", GOOD_MATRIX, intrinsics={"fx": 50, "fy": 50, "cx": 1}),
            "expected cy, got only 'fx', 'fy', 'cx'",
        ),
        (
            matrix_spec("opengl", "camera_to_world", GOOD_MATRIX, intrinsics=[50, 50, 1, 1]),
            "expected intrinsics {fx, fy, cx, cy} in pixels",
        ),
        (matrix_spec("opengl", "camera_to_world", GOOD_MATRIX[:3]), "as four rows of four numbers"),
        (
            matrix_spec("opengl", "camera_to_world", torch.tensor(GOOD_MATRIX).T.tolist()),
            "got [0.0, 0.0, 2.0, 1.0] (it is column major: transpose it)",
        ),
        (
            matrix_spec("opengl", "camera_to_world", [[0] * 4, [0] * 4, [0] * 4, [0, 0, 0, 1]]),
            "expected an invertible camera_to_world",
        ),
        (
            matrix_spec("opengl", "camera_to_world", [[2, 0, 0, 0], *GOOD_MATRIX[1:]]),
            "expected an orthonormal rotation",
        ),
        (
            matrix_spec("opengl", "camera_to_world", [[-1, 0, 0, 0], *GOOD_MATRIX[1:]]),
            "expected a right-handed world_to_camera",
        ),
    ],
)
def test_invalid_spec_says_what_was_expected_and_what_came(spec: Mapping[str, object], message: str) -> None:
    with pytest.raises(CameraInvalid) as error:
        camera_from_spec(spec, WIDTH, HEIGHT)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_read_camera_reads_json() -> None:
    camera = read_camera(json.dumps(LOOK_AT).encode(), WIDTH, HEIGHT)
    assert pixel(camera, 1, 0, 0) == [125, 50, 2]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected a camera as JSON, got b''"),
        (b"[1, 2]", "expected a JSON object"),
        (b"\xff\xfe\x00", "expected a camera as JSON"),
        (b"[" * 60000, "expected a camera as JSON"),
        (
            b'{"type": "look_at", "azimuth_degrees": NaN}',
            "expected azimuth_degrees to be a finite number, got nan",
        ),
        (b" " * 70000, "at most 65536 bytes"),
    ],
)
def test_read_camera_refuses_what_is_no_camera(data: bytes, message: str) -> None:
    with pytest.raises(CameraInvalid) as error:
        read_camera(data, WIDTH, HEIGHT)
    assert message in str(error.value)


def poses(cameras: Mapping[str, Camera]) -> dict[str, Tensor]:
    return {name: camera.world_to_camera for name, camera in cameras.items()}


def test_other_conventions_hold_the_right_reading_of_a_mislabelled_matrix() -> None:
    turned = camera_from_spec({**LOOK_AT, "azimuth_degrees": 70, "elevation_degrees": 35}, WIDTH, HEIGHT)
    opengl = torch.tensor(AXES["opengl"])[:, None] * turned.world_to_camera
    spec = matrix_spec("opencv", "world_to_camera", torch.linalg.inv(opengl).tolist())
    readings = poses(other_conventions(spec, WIDTH, HEIGHT))
    torch.testing.assert_close(readings["convention opengl, camera_to_world"], turned.world_to_camera)
    assert len(readings) == 11  # 3 conventions x 2 directions x 2 transposes, less the given one


def test_other_conventions_of_a_look_at() -> None:
    spec = {**LOOK_AT, "azimuth_degrees": 30, "elevation_degrees": 20}
    readings = poses(other_conventions(spec, WIDTH, HEIGHT))
    for name, changed in {
        "azimuth_degrees negated": {"azimuth_degrees": -30},
        "elevation_degrees negated": {"elevation_degrees": -20},
        "azimuth_degrees +90": {"azimuth_degrees": 120},
    }.items():
        expected = camera_from_spec({**spec, **changed}, WIDTH, HEIGHT)
        torch.testing.assert_close(readings[name], expected.world_to_camera)


def test_other_conventions_leave_out_what_is_the_same() -> None:
    assert "azimuth_degrees negated" not in other_conventions(LOOK_AT, WIDTH, HEIGHT)  # azimuth 0
    front = matrix_spec("opencv", "world_to_camera", FRONT["opencv", "world_to_camera"])  # its own inverse
    assert "convention opencv, camera_to_world" not in other_conventions(front, WIDTH, HEIGHT)
