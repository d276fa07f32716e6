"""The camera that saw a silhouette, in the forms in which a caller may give it: `CameraSpec`.

    {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.9, "fov_y_degrees": 60}
    {"type": "matrix", "convention": "opengl", "camera_to_world": [[...], ...], "fov_y_degrees": 40}
    {"type": "matrix", "convention": "opencv", "world_to_camera": [[...], ...],
     "intrinsics": {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}}

What is wrong with a camera is said here and nowhere else; docs/conventions.md explains the forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, TypeAdapter, field_validator, model_validator

from .strict import Input, Number, Positive, finite, short

FieldOfView = Annotated[float, Field(ge=1e-3, lt=180.0), BeforeValidator(finite)]


def _four_rows(value: Any) -> Any:
    rows = list(value) if isinstance(value, (list, tuple)) else []
    if len(rows) == 16:
        rows = [rows[i : i + 4] for i in range(0, 16, 4)]
    if len(rows) != 4 or any(not isinstance(row, (list, tuple)) or len(row) != 4 for row in rows):
        raise ValueError(f"expected four rows of four numbers, got {short(value)}")
    return rows


Row4 = tuple[Number, Number, Number, Number]
Matrix4 = Annotated[tuple[Row4, Row4, Row4, Row4], BeforeValidator(_four_rows)]
"""Four rows of four numbers, acting on column vectors; 16 numbers, row major, are accepted too."""


class LookAtCamera(Input):
    """A camera at distance * (cos e sin a, sin e, cos e cos a) that looks at the origin, up +Y."""

    type: Literal["look_at"] = "look_at"
    azimuth_degrees: Number
    elevation_degrees: Number = Field(ge=-90.0, le=90.0)
    distance: Positive = Field(description="From the origin, world units.")
    fov_y_degrees: FieldOfView = 60.0


class Intrinsics(Input):
    """Pixels of the given silhouette, centres at +0.5, origin top left; orthographic: fx, fy per unit."""

    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    width: int | None = Field(None, ge=1, description="If given, that of the silhouette.")
    height: int | None = Field(None, ge=1, description="If given, that of the silhouette.")

    def check_size(self, width: int, height: int) -> None:
        """Raise ValueError if they say that they belong to an image of another size."""
        told = (self.width or width, self.height or height)
        if told != (width, height):
            raise ValueError(
                f"expected intrinsics for the silhouette's {width}x{height} pixels, got some for "
                f"{told[0]}x{told[1]}; scale them, or give the silhouette of that size"
            )


class MatrixCamera(Input):
    """A rigid camera matrix in one of its two directions, and intrinsics or a vertical field of view.

    Camera axes by convention: opencv +X right, +Y down, +Z forward; opengl (Blender, glTF) +X right, +Y up,
    -Z forward; pytorch3d +X left, +Y up, +Z forward.
    """

    type: Literal["matrix"] = "matrix"
    convention: Literal["opencv", "opengl", "pytorch3d"]
    world_to_camera: Matrix4 | None = None
    camera_to_world: Matrix4 | None = None
    intrinsics: Intrinsics | None = None
    fov_y_degrees: FieldOfView | None = None
    projection: Literal["perspective", "orthographic"] = "perspective"

    @field_validator("world_to_camera", "camera_to_world")
    @classmethod
    def _is_rigid(cls, matrix: Matrix4 | None) -> Matrix4 | None:
        if matrix is not None:
            _check_rigid(matrix)
        return matrix

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        self._check_exactly_one("world_to_camera", "camera_to_world")
        self._check_exactly_one("intrinsics", "fov_y_degrees")
        if self.projection == "orthographic" and self.intrinsics is None:
            raise ValueError("expected intrinsics for an orthographic camera, got fov_y_degrees")
        return self

    def _check_exactly_one(self, one: str, other: str) -> None:
        given = [name for name in (one, other) if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"expected exactly one of {one} and {other}, got {' and '.join(given) or 'none of them'}"
            )


def _check_rigid(matrix: Matrix4) -> None:
    """Raise ValueError unless `matrix` is a rotation and a translation."""
    if not _close(matrix[3], (0.0, 0.0, 0.0, 1.0), 1e-6):
        transposed = _close([row[3] for row in matrix], (0.0, 0.0, 0.0, 1.0), 1e-6)
        hint = " (it is column major: transpose it)" if transposed else ""
        raise ValueError(f"expected the last row 0 0 0 1, got {list(matrix[3])}{hint}")
    rows = [row[:3] for row in matrix[:3]]
    gram = [sum(x * y for x, y in zip(a, b, strict=True)) for a in rows for b in rows]
    if not _close(gram, (1, 0, 0, 0, 1, 0, 0, 0, 1), 1e-3):
        raise ValueError("expected an orthonormal rotation, got another 3x3 (a scale or a shear? remove it)")
    (a, b, c), (d, e, f), (g, h, i) = rows
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        raise ValueError("expected a right-handed matrix, got a mirrored one (determinant -1)")


def _close(values: Sequence[float], wanted: Sequence[float], tolerance: float) -> bool:
    return all(abs(value - goal) <= tolerance for value, goal in zip(values, wanted, strict=True))


CameraSpec = Annotated[LookAtCamera | MatrixCamera, Field(discriminator="type")]
"""The camera that saw the silhouette, tagged by `type`."""
CAMERA_SPEC: TypeAdapter[LookAtCamera | MatrixCamera] = TypeAdapter(CameraSpec)
"""Reads one: `validate_json`, `validate_python`."""
