"""The values of the contract: REST bodies, SDK values and, through `convert`, gRPC messages.

What a caller sends (RefinementSpec and what is in it) refuses unknown fields, naming the nearest valid one.
What a server sends ignores them, so that an older client can read a newer server.
Conventions: world right-handed, Y up; lengths in world units of the mesh; times in UTC; units in the names.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Base64Bytes,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from .formats import SILHOUETTE_THRESHOLD
from .formats import MeshFormat as MeshFormat  # a value of the contract too

# ---- what a caller sends ----


class Input(BaseModel):
    """Base of everything a caller sends: frozen, finite numbers, no unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _name_the_nearest_field(cls, data: Any) -> Any:
        unknown = [name for name in data if name not in cls.model_fields] if isinstance(data, dict) else []
        if not unknown:
            return data
        raise ValidationError.from_exception_data(
            cls.__name__,
            [
                InitErrorDetails(type=_unknown_field(n, cls.model_fields), loc=(n,), input=data[n])
                for n in unknown
            ],
        )


def _unknown_field(name: object, fields: Iterable[str]) -> PydanticCustomError:
    near = difflib.get_close_matches(str(name), list(fields), n=1, cutoff=0.0)[0]
    return PydanticCustomError(
        "unknown_field",
        "unknown field '{name}'; did you mean '{near}'? (valid: {valid})",
        {"name": str(name)[:100], "near": near, "valid": ", ".join(fields)},
    )


class Preset(StrEnum):
    """The sets of numbers of the method, see the engine's RefineConfig."""

    PAPER = "paper"
    DEFAULT = "default"
    FAST = "fast"


class RefinementOptions(Input):
    """How to refine. Every field has a default; a Refinement shows the effective values."""

    preset: Preset = Preset.DEFAULT
    iterations: int | None = Field(
        None, ge=1, le=10_000, description="Optimisation steps; unset: the preset's."
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="Same seed, same device: same result.")
    symmetry_normal: tuple[float, float, float] = Field(
        (0.0, 0.0, 1.0), description="Normal of the object's mirror plane, world axes; any length but zero."
    )
    symmetry_offset: float | None = Field(
        None,
        description="Where the mirror plane cuts its normal, world units; unset: the coarse mesh decides.",
    )
    silhouette_threshold: float = Field(
        SILHOUETTE_THRESHOLD,
        gt=0.0,
        lt=1.0,
        description="Pixels above this share of full scale are the object.",
    )
    timeout_s: float | None = Field(
        None, gt=0.0, description="Longest running time before DEADLINE_EXCEEDED; unset: the server's limit."
    )

    @field_validator("symmetry_normal")
    @classmethod
    def _has_a_direction(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        if math.hypot(*normal) < 1e-9:
            raise ValueError("expected a normal with a length, got [0, 0, 0]")
        return normal


def _four_rows(value: Any) -> Any:
    flat = isinstance(value, (list, tuple)) and len(value) == 16
    return [value[i : i + 4] for i in range(0, 16, 4)] if flat else value


Row4 = tuple[float, float, float, float]
Matrix4 = Annotated[tuple[Row4, Row4, Row4, Row4], BeforeValidator(_four_rows)]
"""Four rows of four numbers, acting on column vectors; 16 numbers, row major, are accepted too."""


class LookAtCamera(Input):
    """A camera at distance * (cos e sin a, sin e, cos e cos a) that looks at the origin, up +Y."""

    type: Literal["look_at"] = "look_at"
    azimuth_degrees: float
    elevation_degrees: float = Field(ge=-90.0, le=90.0)
    distance: float = Field(gt=0.0, description="From the origin, world units.")
    fov_y_degrees: float = Field(60.0, gt=0.0, lt=180.0)


class Intrinsics(Input):
    """Pixels of the given silhouette, centres at +0.5, origin top left; orthographic: fx, fy per unit."""

    fx: float = Field(gt=0.0)
    fy: float = Field(gt=0.0)
    cx: float
    cy: float
    width: int | None = Field(None, ge=1, description="If given, that of the silhouette.")
    height: int | None = Field(None, ge=1, description="If given, that of the silhouette.")


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
    fov_y_degrees: float | None = Field(None, gt=0.0, lt=180.0)
    projection: Literal["perspective", "orthographic"] = "perspective"

    @field_validator("world_to_camera", "camera_to_world")
    @classmethod
    def _is_rigid(cls, matrix: Matrix4 | None) -> Matrix4 | None:
        if matrix is not None:
            _check_rigid(matrix)
        return matrix

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if (self.world_to_camera is None) == (self.camera_to_world is None):
            raise ValueError("expected exactly one of world_to_camera and camera_to_world")
        if (self.intrinsics is None) == (self.fov_y_degrees is None):
            raise ValueError("expected exactly one of intrinsics and fov_y_degrees")
        if self.projection == "orthographic" and self.intrinsics is None:
            raise ValueError("expected intrinsics for an orthographic camera, got fov_y_degrees")
        return self


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


class RefinementSpec(Input):
    """A request without its files: what the header of gRPC and the multipart fields of REST say."""

    camera: CameraSpec
    options: RefinementOptions = RefinementOptions()
    mesh_format: MeshFormat | None = None


class RefinementRequest(RefinementSpec):
    """The JSON body of `POST /v1/refinements`: a spec and its files in base64."""

    mesh: Base64Bytes = Field(description="The coarse mesh file.")
    silhouette: Base64Bytes = Field(description="The silhouette image file.")


# ---- what a server sends ----


class Output(BaseModel):
    """Base of everything a server sends: frozen; ignores the fields of a newer server."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class State(StrEnum):
    """Where a Refinement is. A terminal state is written once and never changes, until the record expires."""

    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    EXPIRED = "expired"

    @property
    def terminal(self) -> bool:
        """Whether nothing more will happen."""
        return self not in (State.QUEUED, State.RUNNING, State.CANCELLING)


class Progress(Output):
    """How far the optimisation is, at most twice a second."""

    iteration: int
    total: int
    percent: float
    eta_s: float | None = None
    losses: dict[str, float] = Field({}, description="Weighted terms by name, and `total`.")
    silhouette_iou: float = Field(0.0, description="2D IoU of the current iterate with the silhouette.")


class SilhouetteIou(Output):
    """2D IoU with the given silhouette."""

    before: float
    after: float


class Artifact(Output):
    """A file that a refinement made."""

    name: str
    media_type: str
    size_bytes: int
    sha256: str = Field(description="Lower-case hex; also the ETag.")
    url: str | None = None


class RefinementUrls(Output):
    """Where to go on, over REST."""

    refinement: str
    events: str
    cancel: str


class FieldError(Output):
    """One thing wrong with a request."""

    pointer: str = Field(
        description="JSON pointer (RFC 6901) to the field, for instance /options/iterations."
    )
    detail: str


class ProblemDetails(Output):
    """RFC 9457 problem details; see `errors` for the reasons."""

    type: str = "about:blank"
    title: str
    status: int = Field(description="HTTP status.")
    detail: str
    instance: str | None = None
    reason: str
    request_id: str | None = None
    retryable: bool = Field(description="Whether the same request may succeed later.")
    errors: list[FieldError] = []


class Refinement(Output):
    """One refinement: its state and, in the end, its artifacts or its error."""

    id: str
    state: State
    options: RefinementOptions = Field(description="Effective values.")
    progress: Progress | None = None
    error: ProblemDetails | None = None
    artifacts: list[Artifact] = []
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    expires_at: datetime = Field(description="When the record and its artifacts are removed.")
    queue_position: int | None = Field(None, description="Jobs ahead of this one; only while queued.")
    silhouette_iou: SilhouetteIou | None = None
    attempt: int = Field(0, description="How often a worker has started it.")
    urls: RefinementUrls | None = None

    @field_validator("options", mode="before")
    @classmethod
    def _ignore_options_of_a_newer_server(cls, value: Any) -> Any:
        known = RefinementOptions.model_fields
        return {k: v for k, v in value.items() if k in known} if isinstance(value, dict) else value


class RefinementPage(Output):
    """A part of a list, newest first."""

    refinements: list[Refinement] = []
    next_cursor: str | None = Field(
        None, description="Pass it as `cursor` for the next page; unset on the last."
    )


class EventType(StrEnum):
    """What an Event tells."""

    STATE = "state"
    PROGRESS = "progress"
    COMPLETED = "completed"


class Event(Output):
    """One step in the life of a refinement; `completed` is the last and carries the whole Refinement."""

    sequence: int = Field(description="Counts up from 1; SSE's `id`, and what a watcher resumes after.")
    type: EventType
    time: datetime
    state: State
    progress: Progress | None = None
    refinement: Refinement | None = None
