"""The camera that saw a silhouette, in the forms in which a caller may give it: `CameraSpec`.

    {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.9, "fov_y_degrees": 60}
    {"type": "matrix", "convention": "opengl", "camera_to_world": [[...], ...], "fov_y_degrees": 40}
    {"type": "matrix", "convention": "opencv", "world_to_camera": [[...], ...],
     "intrinsics": {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "width": 640, "height": 480}}
    {"type": "pytorch3d", "R": [[...], ...], "T": [...], "fov_y_degrees": 60}
    {"type": "network", "name": "sf3d"}
    {"type": "estimate"}

What is wrong with a camera is said here and nowhere else; docs/conventions.md explains the forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, field_validator, model_validator
from typing_extensions import TypeAliasType  # of typing from Python 3.12 on

from .network_cameras import DISTANCE_OF, PIXEL2MESH_FOV_DEGREES, SPHERES, Network
from .strict import Input, Number, Positive, finite, short

FieldOfView = Annotated[float, Field(ge=1e-3, lt=180.0), BeforeValidator(finite)]


def _rows(value: Any, width: int) -> list[Sequence[Any]] | None:
    """Rows of `width` values each, from rows or from all values in one list; None for anything else."""
    rows = list(value) if isinstance(value, (list, tuple)) else []
    if rows and len(rows) % width == 0 and not any(isinstance(row, (list, tuple)) for row in rows):
        rows = [rows[i : i + width] for i in range(0, len(rows), width)]
    good = all(isinstance(row, (list, tuple)) and len(row) == width for row in rows)
    return rows if good else None


def _four_rows(value: Any) -> Any:
    rows = _rows(value, 4)
    if rows is None or len(rows) not in (3, 4):
        raise ValueError(f"expected three or four rows of four numbers, got {short(value)}")
    return rows if len(rows) == 4 else [*rows, (0.0, 0.0, 0.0, 1.0)]


Row3 = tuple[Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]
Matrix4 = Annotated[tuple[Row4, Row4, Row4, Row4], BeforeValidator(_four_rows)]
"""Four rows of four numbers, acting on column vectors; without the last, or row major in one list, too."""
DEFAULT_FOV_Y_DEGREES = 60.0


class LookAtCamera(Input):
    """A camera at distance * (cos e sin a, sin e, cos e cos a) that looks at the origin, up +Y."""

    type: Literal["look_at"] = "look_at"
    azimuth_degrees: Number
    elevation_degrees: Number = Field(ge=-90.0, le=90.0)
    distance: Positive = Field(description="From the origin, world units.")
    fov_y_degrees: FieldOfView | None = Field(None, description="60 if fov_x_degrees is not given either.")
    fov_x_degrees: FieldOfView | None = None
    roll_degrees: Number = Field(
        0.0, description="By which the camera is turned clockwise about its viewing direction."
    )

    @model_validator(mode="before")
    @classmethod
    def _has_a_field_of_view(cls, data: Any) -> Any:
        given = isinstance(data, dict) and not {"fov_y_degrees", "fov_x_degrees"} & data.keys()
        return {**data, "fov_y_degrees": DEFAULT_FOV_Y_DEGREES} if given else data

    @model_validator(mode="after")
    def _one_field_of_view(self) -> Self:
        _check_exactly_one(self, "fov_y_degrees", "fov_x_degrees")
        return self


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


def _intrinsics_of_matrix(value: Any) -> Any:
    """A 3x3 K as the four numbers in it."""
    rows = _rows(value, 3)
    if rows is None or len(rows) != 3:
        return value
    (fx, skew, cx), (zero, fy, cy), last = rows
    if any((skew, zero, *last[:2])) or last[2] != 1:
        raise ValueError(f"expected a K of the form fx 0 cx / 0 fy cy / 0 0 1, got {short(value)}")
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}


Lens = Annotated[Intrinsics, BeforeValidator(_intrinsics_of_matrix)]
"""Intrinsics, or the 3x3 matrix K of them."""
LENSES = ("intrinsics", "fov_y_degrees", "fov_x_degrees")


def _check_exactly_one(model: Input, *names: str) -> None:
    """Raise ValueError unless one of the fields is given."""
    given = [name for name in names if getattr(model, name) is not None]
    if len(given) != 1:
        listed = " and ".join((", ".join(names[:-1]), names[-1]))
        raise ValueError(f"expected exactly one of {listed}, got {' and '.join(given) or 'none of them'}")


class MatrixCamera(Input):
    """A rigid camera matrix in one of its two directions, and intrinsics or a vertical field of view.

    Camera axes by convention: opencv +X right, +Y down, +Z forward; opengl (Blender, glTF) +X right, +Y up,
    -Z forward; pytorch3d +X left, +Y up, +Z forward.
    """

    type: Literal["matrix"] = "matrix"
    convention: Literal["opencv", "opengl", "pytorch3d"]
    world_to_camera: Matrix4 | None = None
    camera_to_world: Matrix4 | None = None
    intrinsics: Lens | None = None
    fov_y_degrees: FieldOfView | None = None
    fov_x_degrees: FieldOfView | None = None
    projection: Literal["perspective", "orthographic"] = "perspective"

    @field_validator("world_to_camera", "camera_to_world")
    @classmethod
    def _is_rigid(cls, matrix: Matrix4 | None) -> Matrix4 | None:
        if matrix is not None:
            _check_rigid(matrix)
        return matrix

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        _check_exactly_one(self, "world_to_camera", "camera_to_world")
        _check_exactly_one(self, *LENSES)
        if self.projection == "orthographic" and self.intrinsics is None:
            raise ValueError("expected intrinsics for an orthographic camera, got a field of view")
        return self


def _check_rigid(matrix: Matrix4) -> None:
    """Raise ValueError unless `matrix` is a rotation and a translation."""
    if not _close(matrix[3], (0.0, 0.0, 0.0, 1.0), 1e-6):
        transposed = _close([row[3] for row in matrix], (0.0, 0.0, 0.0, 1.0), 1e-6)
        hint = " (it is column major: transpose it)" if transposed else ""
        raise ValueError(f"expected the last row 0 0 0 1, got {list(matrix[3])}{hint}")
    _check_rotation([row[:3] for row in matrix[:3]])


def _check_rotation(rows: Sequence[Row3]) -> None:
    """Raise ValueError unless the rows are orthonormal and right-handed."""
    gram = [sum(x * y for x, y in zip(a, b, strict=True)) for a in rows for b in rows]
    if not _close(gram, (1, 0, 0, 0, 1, 0, 0, 0, 1), 1e-3):
        raise ValueError("expected an orthonormal rotation, got another 3x3 (a scale or a shear? remove it)")
    (a, b, c), (d, e, f), (g, h, i) = rows
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        raise ValueError("expected a right-handed matrix, got a mirrored one (determinant -1)")


def _close(values: Sequence[float], wanted: Sequence[float], tolerance: float) -> bool:
    return all(abs(value - goal) <= tolerance for value, goal in zip(values, wanted, strict=True))


def _three_rows(value: Any) -> Any:
    value = value[0] if isinstance(value, (list, tuple)) and len(value) == 1 else value  # a batch of one
    rows = _rows(value, 3)
    if rows is None or len(rows) != 3:
        raise ValueError(f"expected three rows of three numbers, got {short(value)}")
    return rows


def _one_of_a_batch(value: Any) -> Any:
    batch = isinstance(value, (list, tuple)) and len(value) == 1
    return value[0] if batch else value


Matrix3 = Annotated[tuple[Row3, Row3, Row3], BeforeValidator(_three_rows)]


class PyTorch3DCamera(Input):
    """PyTorch3D's own R and T, for row vectors: X R + T in the camera's axes (+X left, +Y up, +Z forward)."""

    type: Literal["pytorch3d"] = "pytorch3d"
    R: Matrix3
    T: Annotated[Row3, BeforeValidator(_one_of_a_batch)]
    intrinsics: Lens | None = None
    fov_y_degrees: FieldOfView | None = None
    fov_x_degrees: FieldOfView | None = None

    @field_validator("R")
    @classmethod
    def _is_a_rotation(cls, rows: Matrix3) -> Matrix3:
        _check_rotation(rows)
        return rows

    @model_validator(mode="after")
    def _one_lens(self) -> Self:
        _check_exactly_one(self, *LENSES)
        return self

    def plain(self) -> MatrixCamera:
        """The same camera as a matrix."""
        columns = zip(*self.R, strict=True)
        rows = [(*column, shift) for column, shift in zip(columns, self.T, strict=True)]
        lens = {name: getattr(self, name) for name in LENSES}
        return MatrixCamera.model_validate({"convention": "pytorch3d", "world_to_camera": rows, **lens})


class NetworkCamera(Input):
    """The camera of a network's input image, as its project publishes it, in the frame of its output."""

    type: Literal["network"] = "network"
    name: Network
    azimuth_degrees: Number | None = Field(None, description="In the network's own sense; 0 if left out.")
    elevation_degrees: Annotated[Number, Field(ge=-90.0, le=90.0)] | None = Field(
        None, description="0 if left out."
    )
    distance: Positive | None = Field(None, description="Unset: the published one.")
    fov_y_degrees: FieldOfView | None = Field(None, description="Unset: the published one.")

    @model_validator(mode="after")
    def _fits_the_network(self) -> Self:
        placed = ("azimuth_degrees", "elevation_degrees", "distance")
        told = [name for name in placed if getattr(self, name) is not None]
        if self.name not in SPHERES and told:
            raise ValueError(f"expected no {told[0]}: {self.name}'s output is in its camera's own axes")
        if self.name in DISTANCE_OF and self.distance is None:
            raise ValueError(f"expected distance, got none; for {self.name} {DISTANCE_OF[self.name]}")
        return self

    def plain(self) -> MatrixCamera:
        """The same camera as a matrix."""
        if self.name not in SPHERES:
            rows: Any = [(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)]
            fov = PIXEL2MESH_FOV_DEGREES
        else:
            sphere = SPHERES[self.name]
            distance = self.distance or sphere.distance or 0.0
            rows = sphere.camera_to_world(
                self.azimuth_degrees or 0.0, self.elevation_degrees or 0.0, distance
            )
            fov = sphere.fov_y_degrees
        told = {"convention": "opengl", "camera_to_world": rows, "fov_y_degrees": self.fov_y_degrees or fov}
        return MatrixCamera.model_validate(told)


class EstimatedCamera(Input):
    """Not known: estimated from the mesh and the silhouette. What is known of it helps.

    Angles as of a LookAtCamera, but about the middle of the mesh.
    """

    type: Literal["estimate"] = "estimate"
    fov_y_degrees: FieldOfView | None = Field(None, description="If it is known, as fov_x_degrees is.")
    fov_x_degrees: FieldOfView | None = None
    azimuth_degrees: Number | None = Field(None, description="Roughly: looked for up to 45 degrees away.")
    elevation_degrees: Annotated[Number, Field(ge=-90.0, le=90.0)] | None = Field(
        None, description="Roughly: looked for up to 30 degrees away."
    )
    roll_degrees: Number = Field(0.0, description="Exactly; clockwise turn about the viewing direction.")

    @model_validator(mode="after")
    def _at_most_one_field_of_view(self) -> Self:
        if self.fov_y_degrees is not None and self.fov_x_degrees is not None:
            raise ValueError("expected at most one of fov_y_degrees and fov_x_degrees, got both")
        return self


PlainCamera = LookAtCamera | MatrixCamera
"""The two forms that all others but an EstimatedCamera become once they are read."""


def _plain(
    camera: PlainCamera | PyTorch3DCamera | NetworkCamera | EstimatedCamera,
) -> PlainCamera | EstimatedCamera:
    return camera.plain() if isinstance(camera, PyTorch3DCamera | NetworkCamera) else camera


if TYPE_CHECKING:
    CameraSpec = PlainCamera | EstimatedCamera  # what reading gives
else:
    CameraSpec = TypeAliasType(  # a name, under which OpenAPI has it
        "CameraSpec",
        Annotated[
            Annotated[
                LookAtCamera | MatrixCamera | PyTorch3DCamera | NetworkCamera | EstimatedCamera,
                Field(discriminator="type"),
            ],
            AfterValidator(_plain),
        ],
    )
"""The camera that saw the silhouette, tagged by `type`, in any of its forms."""
CAMERA_SPEC: TypeAdapter[PlainCamera | EstimatedCamera] = TypeAdapter(CameraSpec)
"""Reads one: `validate_json`, `validate_python`."""
