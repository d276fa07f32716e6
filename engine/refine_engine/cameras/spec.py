"""Cameras as users write them (JSON) -> Camera, the one internal form. docs/conventions.md shows every form.

    {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.9, "fov_y_degrees": 60}
    {"type": "matrix", "convention": "opengl", "camera_to_world": [[...], ...], "fov_y_degrees": 40}
    {"type": "matrix", "convention": "opencv", "world_to_camera": [[...], ...],
     "intrinsics": {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}}

A matrix is four rows of four numbers, or the same 16 in one list, and acts on column vectors. It may say
`"projection": "orthographic"`: fx and fy of its intrinsics are then pixels per world unit. `width` and
`height` of the intrinsics are optional; given, they must be those of the silhouette.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import torch
from torch import Tensor

from ..errors import CameraInvalid
from ..values import Camera, Projection

MAX_BYTES = 65536  # a camera is a few hundred bytes
DEFAULT_FOV_Y_DEGREES = 60.0

Convention = Literal["opencv", "opengl", "pytorch3d"]
Direction = Literal["world_to_camera", "camera_to_world"]
T = TypeVar("T", bound=str)

# The camera axes of each convention in OpenCV's (+X right, +Y down, +Z forward), as the diagonal of a flip.
AXES: Mapping[Convention, tuple[float, float, float, float]] = {
    "opencv": (1.0, 1.0, 1.0, 1.0),
    "opengl": (1.0, -1.0, -1.0, 1.0),  # +X right, +Y up, -Z forward: Blender, glTF
    "pytorch3d": (-1.0, -1.0, 1.0, 1.0),  # +X left, +Y up, +Z forward
}
DIRECTIONS: tuple[Direction, ...] = ("world_to_camera", "camera_to_world")
PROJECTIONS: tuple[Projection, ...] = ("perspective", "orthographic")
LENSES = ("intrinsics", "fov_y_degrees")
FIELDS = {
    "look_at": ("type", "azimuth_degrees", "elevation_degrees", "distance", "fov_y_degrees"),
    "matrix": ("type", "convention", *DIRECTIONS, *LENSES, "projection"),
}
INTRINSICS = ("fx", "fy", "cx", "cy", "width", "height")


def read_camera(data: bytes, width: int, height: int) -> Camera:
    """The camera in a JSON file, for a silhouette of `width` x `height` pixels; raises CameraInvalid."""
    return camera_from_spec(parse_spec(data), width, height)


def parse_spec(data: bytes) -> Mapping[str, object]:
    """The JSON object in `data`, not yet judged; raises CameraInvalid when it is not one."""
    if len(data) > MAX_BYTES:
        raise CameraInvalid(f"expected a camera of at most {MAX_BYTES} bytes of JSON, got {len(data)} bytes")
    try:
        spec = json.loads(data)
    except (ValueError, RecursionError) as error:  # ValueError: not JSON, not UTF-8, a number too long
        raise CameraInvalid(f"expected a camera as JSON, got {_short(data)} ({error})") from error
    if not isinstance(spec, dict):
        raise CameraInvalid(f'expected a JSON object such as {{"type": "look_at", ...}}, got {_short(spec)}')
    return spec


def camera_from_spec(spec: Mapping[str, object], width: int, height: int) -> Camera:
    """The camera that `spec` describes, for an image of `width` x `height` pixels.

    Raises CameraInvalid for an unknown field (with the nearest valid name), a missing or contradictory one,
    a value out of range, a matrix that is no rigid motion, and intrinsics for another size of image.
    """
    _check_fields(spec, FIELDS[_choice(spec, "type", tuple(FIELDS))], "the camera")
    if spec["type"] == "look_at":
        return _look_at(spec, width, height)
    return _matrix_reading(spec).camera(_lens_of_matrix(spec, width, height))


def other_conventions(spec: Mapping[str, object], width: int, height: int) -> dict[str, Camera]:
    """What the numbers of a valid `spec` mean in the other usual conventions: description -> camera.

    Readings that are no camera or the same camera as the given one are left out.
    """
    given = camera_from_spec(spec, width, height)
    readings = _other_look_ats(spec, given) if spec["type"] == "look_at" else _other_matrices(spec, given)
    cameras: dict[str, Camera] = {}
    for name, camera in readings.items():
        seen = (given, *cameras.values())
        if not any(torch.allclose(camera.world_to_camera, c.world_to_camera, atol=1e-5) for c in seen):
            cameras[name] = camera
    return cameras


# ---------------------------------------------------------------------------------------------- look_at


def _look_at(spec: Mapping[str, object], width: int, height: int) -> Camera:
    azimuth = _number(spec, "azimuth_degrees")
    elevation = _number(spec, "elevation_degrees", -90.0, 90.0)
    distance = _number(spec, "distance", 0.0, math.inf, open_ends=True)
    fov_y = _fov_y_degrees(spec, default=DEFAULT_FOV_Y_DEGREES)
    return Camera.look_at(azimuth, elevation, distance, fov_y, width, height)


def _other_look_ats(spec: Mapping[str, object], given: Camera) -> dict[str, Camera]:
    """Azimuth counted the other way or from another axis, elevation downwards, a world with Z up."""
    azimuth, elevation = _number(spec, "azimuth_degrees"), _number(spec, "elevation_degrees")
    angles = {
        "azimuth_degrees negated": (-azimuth, elevation),
        "elevation_degrees negated": (azimuth, -elevation),
        **{f"azimuth_degrees {turn:+}": (azimuth + turn, elevation) for turn in (90, -90, 180)},
    }
    cameras = {}
    for name, (a, e) in angles.items():
        pose = Camera.look_at(a, e, _number(spec, "distance"), DEFAULT_FOV_Y_DEGREES, 1, 1)
        cameras[name] = replace(given, world_to_camera=pose.world_to_camera)
    z_up = torch.tensor(
        [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    )  # (x, y, z) -> (x, z, -y)
    cameras["a mesh with Z up (turn it to Y up)"] = replace(
        given, world_to_camera=given.world_to_camera @ z_up
    )
    return cameras


# ----------------------------------------------------------------------------------------------- matrix


@dataclass(frozen=True)
class _MatrixReading:
    """A 4x4 matrix and what it is taken to mean."""

    matrix: Tensor  # (4, 4) float64, last row 0 0 0 1
    convention: Convention
    direction: Direction
    transposed: bool = False  # the rotation acts on row vectors, as PyTorch3D's R does

    def camera(self, lens: Camera) -> Camera:
        """`lens` at the pose that this reading gives; raises CameraInvalid when it is not rigid."""
        matrix = self.matrix.clone()
        if self.transposed:
            matrix[:3, :3] = self.matrix[:3, :3].T
        if self.direction == "camera_to_world":
            if float(torch.linalg.det(matrix).abs()) < 1e-12:
                raise CameraInvalid("expected an invertible camera_to_world, got a singular matrix")
            matrix = torch.linalg.inv(matrix)
        flip = torch.tensor(AXES[self.convention], dtype=torch.float64)
        return replace(lens, world_to_camera=(flip[:, None] * matrix).float())

    def describe(self) -> str:
        rotation = " with the rotation transposed" if self.transposed else ""
        return f"convention {self.convention}, {self.direction}{rotation}"


def _matrix_reading(spec: Mapping[str, object]) -> _MatrixReading:
    convention = _choice(spec, "convention", tuple(AXES))
    given = [direction for direction in DIRECTIONS if direction in spec]
    if len(given) != 1:
        raise _not_exactly_one(DIRECTIONS, given)
    return _MatrixReading(_rigid(spec[given[0]], given[0]), convention, given[0])


def _rigid(value: object, name: str) -> Tensor:
    """(4, 4) float64. That the rotation is one is checked by Camera."""
    rows = list(value) if isinstance(value, list | tuple) else []
    if len(rows) == 16:
        rows = [rows[i : i + 4] for i in range(0, 16, 4)]
    if len(rows) != 4 or any(not isinstance(row, list | tuple) or len(row) != 4 for row in rows):
        raise CameraInvalid(f"expected {name} as four rows of four numbers, got {_short(value)}")
    cells = [_finite(cell, f"{name}[{i}][{j}]") for i, row in enumerate(rows) for j, cell in enumerate(row)]
    matrix = torch.tensor(cells, dtype=torch.float64).reshape(4, 4)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    if not torch.allclose(matrix[3], bottom, atol=1e-6):
        column_major = torch.allclose(matrix[:, 3], bottom, atol=1e-6)
        hint = " (it is column major: transpose it)" if column_major else ""
        raise CameraInvalid(f"expected {name} with the last row 0 0 0 1, got {matrix[3].tolist()}{hint}")
    return matrix


def _other_matrices(spec: Mapping[str, object], given: Camera) -> dict[str, Camera]:
    told = _matrix_reading(spec)
    cameras = {}
    for transposed in (False, True):
        for direction in (told.direction, *(d for d in DIRECTIONS if d != told.direction)):
            for convention in AXES:
                reading = replace(told, convention=convention, direction=direction, transposed=transposed)
                with suppress(CameraInvalid):  # inverting can push a barely rigid matrix over the tolerance
                    cameras[reading.describe()] = reading.camera(given)
    return cameras


# ------------------------------------------------------------------------------------------------- lens


def _lens_of_matrix(spec: Mapping[str, object], width: int, height: int) -> Camera:
    """The intrinsics and the projection of a `matrix` spec, as a camera at the origin."""
    projection = _choice(spec, "projection", PROJECTIONS, default="perspective")
    given = [name for name in LENSES if name in spec]
    if len(given) != 1:
        raise _not_exactly_one(LENSES, given)
    if projection == "orthographic" and given != ["intrinsics"]:
        raise CameraInvalid("expected intrinsics for an orthographic camera, got fov_y_degrees")
    if "intrinsics" in spec:
        fx, fy, cx, cy = _intrinsics(spec["intrinsics"], width, height)
    else:
        fx = fy = 0.5 * height / math.tan(math.radians(_fov_y_degrees(spec)) / 2)
        cx, cy = width / 2, height / 2
    return Camera(torch.eye(4), fx, fy, cx, cy, width, height, projection)


def _fov_y_degrees(spec: Mapping[str, object], default: float | None = None) -> float:
    return _number(spec, "fov_y_degrees", 0.0, 180.0, open_ends=True, default=default)


def _intrinsics(value: object, width: int, height: int) -> tuple[float, float, float, float]:
    if not isinstance(value, Mapping):
        raise CameraInvalid(f"expected intrinsics {{fx, fy, cx, cy}} in pixels, got {_short(value)}")
    _check_fields(value, INTRINSICS, "intrinsics")
    told = (_number(value, "width", default=width), _number(value, "height", default=height))
    if told != (width, height):
        raise CameraInvalid(
            f"expected intrinsics for the silhouette's {width}x{height} pixels, got some for "
            f"{told[0]:g}x{told[1]:g}; scale them, or give the silhouette of that size"
        )
    fx, fy = (_number(value, name, 0.0, math.inf, open_ends=True) for name in ("fx", "fy"))
    return fx, fy, _number(value, "cx"), _number(value, "cy")


# ------------------------------------------------------------------------------------- fields and values


def _check_fields(spec: Mapping[str, object], valid: Collection[str], where: str) -> None:
    for name in spec:
        if name not in valid:
            near = difflib.get_close_matches(str(name), valid, n=1, cutoff=0.4)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise CameraInvalid(f"expected {', '.join(valid)} in {where}, got {_short(name)}{hint}")


def _choice(spec: Mapping[str, object], name: str, valid: Sequence[T], default: T | None = None) -> T:
    value = spec.get(name, default)
    for choice in valid:
        if value == choice:
            return choice
    near = difflib.get_close_matches(str(value).lower(), valid, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    came = _short(value) if name in spec else "none"
    raise CameraInvalid(f"expected {name} to be one of {', '.join(valid)}, got {came}{hint}")


def _number(
    spec: Mapping[str, object],
    name: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    open_ends: bool = False,
    default: float | None = None,
) -> float:
    if name not in spec and default is not None:
        return default
    if name not in spec:
        raise CameraInvalid(f"expected {name}, got only {', '.join(map(_short, spec))}")
    value = _finite(spec[name], name)
    inside = low < value < high if open_ends else low <= value <= high
    if not inside:
        between = f"above {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
        raise CameraInvalid(f"expected {name} {between}, got {value:g}")
    return value


def _finite(value: object, name: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e30:
        return float(value)
    raise CameraInvalid(f"expected {name} to be a finite number, got {_short(value)}")


def _not_exactly_one(names: Sequence[str], given: Sequence[str]) -> CameraInvalid:
    return CameraInvalid(
        f"expected exactly one of {', '.join(names)}, got {' and '.join(given) or 'none of them'}"
    )


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
