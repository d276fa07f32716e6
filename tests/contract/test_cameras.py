"""What is wrong with a camera is said once, in the contract, with what was expected, what came and a hint."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from refine_proto.cameras import CAMERA_SPEC, Intrinsics, LookAtCamera
from refine_proto.strict import complaints, in_one_line

LOOK_AT = {
    "type": "look_at",
    "azimuth_degrees": 0,
    "elevation_degrees": 0,
    "distance": 2,
    "fov_y_degrees": 90,
}
INTRINSICS = {"fx": 50, "fy": 50, "cx": 100, "cy": 50}
POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
MATRIX = {"type": "matrix", "convention": "opengl", "camera_to_world": POSE, "intrinsics": INTRINSICS}

PYTORCH3D = {"type": "pytorch3d", "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "T": [0, 0, 2], "fov_y_degrees": 60}


def without(camera: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in camera.items() if name not in names}


def complaint(error: ValidationError) -> str:
    return in_one_line(complaints(error.errors(), under=("camera",)))


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({}, "/camera: expected 'type' to be one of 'look_at', 'matrix', 'pytorch3d', 'network', got none"),
        (
            {"type": "lookat"},
            "one of 'look_at', 'matrix', 'pytorch3d', 'network', 'estimate', got 'lookat'; "
            "did you mean 'look_at'?",
        ),
        ([1, 2], "/camera: expected an object, got [1, 2]"),
        (
            LOOK_AT | {"azimut_degrees": 1},
            "/camera/azimut_degrees: unknown field 'azimut_degrees'; did you mean 'azi",
        ),
        (
            {"type": "look_at", "azimuth_degrees": 1},
            "/camera/distance: expected this required field, got only type, azimuth_degrees",
        ),
        (LOOK_AT | {"elevation_degrees": 91}, "expected a number less than or equal to 90, got 91"),
        (LOOK_AT | {"distance": 0}, "/camera/distance: expected a number greater than 0, got 0"),
        (LOOK_AT | {"distance": True}, "/camera/distance: expected a finite number below 1e+30, got True"),
        (LOOK_AT | {"distance": "2"}, "expected a finite number below 1e+30, got '2'"),
        (LOOK_AT | {"distance": None}, "expected a finite number below 1e+30, got None"),
        (LOOK_AT | {"distance": math.nan}, "expected a finite number below 1e+30, got nan"),
        (LOOK_AT | {"distance": 1e31}, "expected a finite number below 1e+30, got 1e+31"),
        (LOOK_AT | {"distance": 10**400}, "expected a finite number below 1e+30, got 1000"),
        (LOOK_AT | {"distance": 10**9999}, "got an integer of thousands of digits"),
        (LOOK_AT | {"fov_y_degrees": 180}, "expected a number less than 180, got 180"),
        (
            LOOK_AT | {"fov_x_degrees": 60},
            "exactly one of fov_y_degrees and fov_x_degrees, got fov_y_degrees and",
        ),
        (
            MATRIX | {"intrinsics": [[50, 1, 3], [0, 50, 3], [0, 0, 1]]},
            "/camera/intrinsics: expected a K of the",
        ),
        (PYTORCH3D | {"R": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "/camera/R: expected an orthonormal rotation"),
        (PYTORCH3D | {"R": POSE}, "/camera/R: expected three rows of three numbers"),
        (
            PYTORCH3D | {"fov_x_degrees": 5},
            "/camera: expected exactly one of intrinsics, fov_y_degrees and fov_x",
        ),
        ({"type": "network", "name": "trelis"}, "/camera/name: expected 'triposr', 'sf3d'"),
        ({"type": "network", "name": "occnet"}, "expected distance, got none; for occnet 1.75 times"),
        (
            {"type": "network", "name": "pixel2mesh", "azimuth_degrees": 0},
            "/camera: expected no azimuth_degrees: pixel2mesh's output is in its camera's own axes",
        ),
        (MATRIX | {"convention": "OpenGL"}, "'pytorch3d', got 'OpenGL'; did you mean 'opengl'?"),
        (MATRIX | {"camera_to_word": POSE}, "did you mean 'camera_to_world'?"),
        (MATRIX | {"projection": "ortographic"}, "did you mean 'orthographic'?"),
        (
            without(MATRIX, "camera_to_world"),
            "/camera: expected exactly one of world_to_camera and camera_to_world, got none of them",
        ),
        (MATRIX | {"world_to_camera": POSE}, "got world_to_camera and camera_to_world"),
        (
            MATRIX | {"fov_y_degrees": 40},
            "exactly one of intrinsics, fov_y_degrees and fov_x_degrees, got intrinsics and fov_y_degrees",
        ),
        (
            without(MATRIX, "intrinsics") | {"fov_y_degrees": 60, "projection": "orthographic"},
            "expected intrinsics for an orthographic camera, got a field of view",
        ),
        (
            MATRIX | {"intrinsics": without(INTRINSICS, "cy")},
            "/camera/intrinsics/cy: expected this required field, got only fx, fy, cx",
        ),
        (
            MATRIX | {"intrinsics": [50, 50, 1, 1]},
            "/camera/intrinsics: expected an object, got [50, 50, 1, 1]",
        ),
        (
            MATRIX | {"camera_to_world": POSE[:2]},
            "/camera/camera_to_world: expected three or four rows of four numbers, got [[1, 0",
        ),
        (MATRIX | {"camera_to_world": 3}, "expected three or four rows of four numbers, got 3"),
        (
            MATRIX | {"camera_to_world": np.array(POSE).T.tolist()},
            "got [0.0, 0.0, 2.0, 1.0] (it is column major: transpose it)",
        ),
        (MATRIX | {"camera_to_world": [[0] * 4] * 3 + [[0, 0, 0, 1]]}, "expected an orthonormal rotation"),
        (
            MATRIX | {"camera_to_world": [[2, 0, 0, 0], *POSE[1:]]},
            "expected an orthonormal rotation, got another 3x3 (a scale or a shear? remove it)",
        ),
        (MATRIX | {"camera_to_world": [[-1, 0, 0, 0], *POSE[1:]]}, "expected a right-handed matrix"),
        (
            MATRIX | {"camera_to_world": [[1, 0, 0, False], *POSE[1:]]},
            "/camera/camera_to_world/0/3: expected a finite number below 1e+30, got False",
        ),
    ],
)
def test_a_bad_camera_is_told_what_was_expected_and_what_came(camera: Any, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        CAMERA_SPEC.validate_python(camera)
    assert message in complaint(caught.value)
    assert "\n" not in complaint(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "/camera: expected JSON, got b'' (EOF"),
        (b"\xff\xfe\x00", "expected JSON, got b'\\xff"),
        (b"[" * 60000, "recursion limit exceeded"),
        (b'{"type": "look_at", "azimuth_degrees": NaN}', "/camera/azimuth_degrees: expected a finite number"),
        (b'{"type": "look_at", "azimuth_degrees": 1' + b"0" * 9999 + b"}", "expected JSON"),
    ],
)
def test_what_is_no_json_is_no_camera(data: bytes, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        CAMERA_SPEC.validate_json(data)
    assert message in complaint(caught.value)
    assert len(complaint(caught.value)) < 400


def test_numbers_of_numpy_are_numbers() -> None:
    camera = LookAtCamera(
        azimuth_degrees=np.float32(30), elevation_degrees=np.float64(1), distance=np.int64(2)
    )
    assert json.loads(camera.model_dump_json())["azimuth_degrees"] == 30


def test_intrinsics_say_which_image_they_belong_to() -> None:
    intrinsics = Intrinsics.model_validate(INTRINSICS | {"width": 100, "height": 200})
    intrinsics.check_size(100, 200)
    Intrinsics.model_validate(INTRINSICS | {"width": 100}).check_size(100, 200)
    with pytest.raises(
        ValueError, match="expected intrinsics for the silhouette's 200x100 pixels, got some for 100x200"
    ):
        intrinsics.check_size(200, 100)
