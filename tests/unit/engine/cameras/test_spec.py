"""Every way to write a camera, checked on pixels computed by hand."""

import json
import math
from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from refine_engine.cameras.project import project
from refine_engine.cameras.readings import other_readings
from refine_engine.cameras.spec import AXES, camera_from_spec, read_camera
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


def camera_of(spec: Mapping[str, object], width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return camera_from_spec(read_camera(spec), width, height)


def nearly_rigid(error: float) -> list[list[float]]:
    """Every product of two rows is off by `error`; the contract lets 1e-3 pass."""
    gram = torch.eye(3, dtype=torch.float64) + error
    turn = Camera.look_at(35.3, 45.0, 1, 60, 1, 1).world_to_camera[:3, :3].double()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.linalg.cholesky(gram) @ torch.linalg.qr(turn)[0]
    matrix[:3, :3] *= torch.linalg.det(matrix[:3, :3]).sign()
    rows: list[list[float]] = matrix.tolist()
    return rows


def far_away(distance: float) -> list[list[float]]:
    return [[1, 0, 0, distance], [0, 1, 0, -distance], [0, 0, 1, distance], [0, 0, 0, 1]]


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
    assert pixel(camera_of(spec), *point) == expected


def test_look_at_stands_where_the_convention_says() -> None:
    spec = {**LOOK_AT, "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 3}
    camera = camera_of(spec)
    a, e = math.radians(30), math.radians(20)
    position = torch.tensor([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)]) * 3
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    torch.testing.assert_close(-rotation.T @ translation, position)


def test_look_at_fov_defaults_to_60_degrees() -> None:
    spec = {name: value for name, value in LOOK_AT.items() if name != "fov_y_degrees"}
    assert camera_of(spec).fx == pytest.approx(50 / math.tan(math.radians(30)))


@pytest.mark.parametrize(("convention", "direction"), FRONT)
@pytest.mark.parametrize("lens", [{"intrinsics": INTRINSICS}, {"fov_y_degrees": 90}])
def test_every_convention_gives_the_same_pixels(
    convention: str, direction: str, lens: dict[str, object]
) -> None:
    spec = matrix_spec(convention, direction, FRONT[convention, direction], **lens)
    camera = camera_of(spec)
    assert pixel(camera, 1, 0, 1) == [150, 50, 1]
    assert pixel(camera, 0, 1, 0) == [100, 25, 2]


@pytest.mark.parametrize(("convention", "axes"), AXES.items())
def test_every_convention_agrees_from_the_side(convention: str, axes: tuple[float, ...]) -> None:
    expected = camera_of({**LOOK_AT, "azimuth_degrees": 70, "elevation_degrees": 35})
    matrix = torch.tensor(axes)[:, None] * expected.world_to_camera
    for direction, rows in (("world_to_camera", matrix), ("camera_to_world", torch.linalg.inv(matrix))):
        spec = matrix_spec(convention, direction, rows.tolist())
        given = camera_of(spec)
        torch.testing.assert_close(given.world_to_camera, expected.world_to_camera)


def test_unequal_intrinsics_on_a_tall_image() -> None:
    intrinsics = {"fx": 30, "fy": 40, "cx": 10, "cy": 70}
    spec = matrix_spec("opengl", "camera_to_world", FRONT["opengl", "camera_to_world"], intrinsics=intrinsics)
    assert pixel(camera_of(spec, 80, 160), 1, 1, 0) == [10 + 15, 70 - 20, 2]


def test_orthographic_ignores_the_depth() -> None:
    intrinsics = {"fx": 25, "fy": 25, "cx": 100, "cy": 50}
    spec = matrix_spec("opengl", "camera_to_world", FRONT["opengl", "camera_to_world"], intrinsics=intrinsics)
    camera = camera_of({**spec, "projection": "orthographic"})
    assert pixel(camera, 1, 1, 0)[:2] == [125, 25]
    assert pixel(camera, 1, 1, 1)[:2] == [125, 25]


def test_sixteen_numbers_are_four_rows() -> None:
    rows = FRONT["opengl", "world_to_camera"]
    flat = matrix_spec("opengl", "world_to_camera", [cell for row in rows for cell in row])
    assert pixel(camera_of(flat), 1, 0, 1) == [150, 50, 1]


def test_intrinsics_may_say_their_size() -> None:
    intrinsics = {**INTRINSICS, "width": WIDTH, "height": HEIGHT}
    spec = matrix_spec("opengl", "world_to_camera", FRONT["opengl", "world_to_camera"], intrinsics=intrinsics)
    assert camera_of(spec).cx == 100


def test_intrinsics_of_another_size_are_refused() -> None:
    intrinsics = {**INTRINSICS, "width": HEIGHT, "height": WIDTH}
    spec = matrix_spec("opengl", "world_to_camera", FRONT["opengl", "world_to_camera"], intrinsics=intrinsics)
    message = "expected intrinsics for the silhouette's 200x100 pixels, got some for 100x200"
    with pytest.raises(CameraInvalid, match=message):
        camera_of(spec)


@pytest.mark.parametrize(
    "spec",
    [
        *(matrix_spec(*form, matrix) for form, matrix in FRONT.items()),
        {**LOOK_AT, "fov_y_degrees": 1e-3, "distance": 1e-300},
        {**LOOK_AT, "fov_y_degrees": math.nextafter(180, 0), "distance": 9e29, "azimuth_degrees": -9e29},
        matrix_spec("opencv", "camera_to_world", nearly_rigid(9e-4), fov_y_degrees=60),
        matrix_spec("opencv", "camera_to_world", nearly_rigid(-9e-4), fov_y_degrees=60),
        matrix_spec("opengl", "camera_to_world", far_away(9e29), intrinsics=dict.fromkeys(INTRINSICS, 9e29)),
    ],
)
def test_the_engine_takes_every_camera_that_the_contract_lets_in(spec: Mapping[str, object]) -> None:
    """Also after an inversion, in float32, and read in another convention."""
    camera = camera_of(spec)
    assert other_readings(read_camera(spec), camera)


def test_read_camera_reads_json_and_objects() -> None:
    for given in (json.dumps(LOOK_AT).encode(), LOOK_AT):
        camera = camera_from_spec(read_camera(given), WIDTH, HEIGHT)
        assert pixel(camera, 1, 0, 0) == [125, 50, 2]


@pytest.mark.parametrize("given", [b"[1, 2]", {**LOOK_AT, "distance": 0}])
def test_read_camera_refuses_in_the_words_of_the_contract(given: bytes | Mapping[str, object]) -> None:
    with pytest.raises(CameraInvalid, match=r"^/camera(/distance)?: expected "):
        read_camera(given)


def others(spec: Mapping[str, object]) -> dict[str, Tensor]:
    readings = other_readings(read_camera(spec), camera_of(spec))
    return {name: camera.world_to_camera for name, camera in readings.items()}


def test_other_readings_hold_the_right_reading_of_a_mislabelled_matrix() -> None:
    turned = camera_of({**LOOK_AT, "azimuth_degrees": 70, "elevation_degrees": 35})
    opengl = torch.tensor(AXES["opengl"])[:, None] * turned.world_to_camera
    spec = matrix_spec("opencv", "world_to_camera", torch.linalg.inv(opengl).tolist())
    readings = others(spec)
    torch.testing.assert_close(readings["convention opengl, camera_to_world"], turned.world_to_camera)
    assert (
        sum(name.startswith("convention") for name in readings) == 11
    )  # 3 x 2 directions x 2 transposes - 1


def test_other_readings_of_a_look_at() -> None:
    spec = {**LOOK_AT, "azimuth_degrees": 30, "elevation_degrees": 20}
    readings = others(spec)
    for name, changed in {
        "azimuth negated": {"azimuth_degrees": -30},
        "elevation negated": {"elevation_degrees": -20},
        "azimuth +90": {"azimuth_degrees": 120},
    }.items():
        expected = camera_of({**spec, **changed})
        torch.testing.assert_close(readings[name], expected.world_to_camera)


def test_other_readings_leave_out_what_is_the_same() -> None:
    assert "azimuth negated" not in others(LOOK_AT)  # azimuth 0
    front = matrix_spec("opencv", "world_to_camera", FRONT["opencv", "world_to_camera"])  # its own inverse
    assert "convention opencv, camera_to_world" not in others(front)
