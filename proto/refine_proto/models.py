"""The values of the contract: REST bodies, SDK values and, through `convert`, gRPC messages.

What a caller sends (RefinementSpec and what is in it) refuses unknown fields, naming the nearest valid one.
What a server sends ignores them, and keeps a state or a preset that it does not list as it is, so that an
older version can read a newer one.
Conventions: world right-handed, Y up; lengths in world units of the mesh; times in UTC; units in the names.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from enum import StrEnum
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from .base64_bytes import Base64Bytes

# "X as X": callers find all values of the contract here.
from .cameras import CameraSpec as CameraSpec
from .cameras import EstimatedCamera as EstimatedCamera
from .cameras import Intrinsics as Intrinsics
from .cameras import LookAtCamera as LookAtCamera
from .cameras import MatrixCamera as MatrixCamera
from .cameras import NetworkCamera as NetworkCamera
from .cameras import PyTorch3DCamera as PyTorch3DCamera
from .checks import Checks as Checks
from .checks import Finding as Finding
from .checks import Reading as Reading
from .checks import Severity as Severity
from .formats import MAX_VIEWS, SILHOUETTE_THRESHOLD
from .formats import MeshFormat as MeshFormat
from .metadata import Metadata as Metadata
from .open_enum import OpenEnum, of_newer_version
from .strict import Input, Number, Positive
from .webhooks import Url
from .webhooks import Webhook as Webhook
from .webhooks import WebhookDelivery as WebhookDelivery
from .webhooks import WebhookEvent as WebhookEvent

# ---- what a caller sends ----


class Preset(StrEnum):
    """The sets of numbers of the method, see the engine's RefineConfig."""

    PAPER = "paper"
    DEFAULT = "default"
    FAST = "fast"


class Symmetry(StrEnum):
    """Where the object's mirror plane comes from."""

    AUTO = "auto"  # found on the coarse mesh; none if it has none
    PLANE = "plane"  # given by its normal, (0, 0, 1) unless said otherwise
    NONE = "none"  # the object has none


class Topology(StrEnum):
    """Which faces of the coarse mesh the refined one has."""

    OPEN = "open"  # webs over holes, which cover the silhouette's background, are removed
    FIXED = "fixed"  # all


class Priority(StrEnum):
    """Which of the queued refinements are to start sooner."""

    LOW = "low"  # after others' of the next minute, with a quarter of a share
    NORMAL = "normal"
    HIGH = "high"  # before others' of the last minute, with four shares


_KINDS: Mapping[str, type[StrEnum]] = {
    "preset": Preset,
    "symmetry": Symmetry,
    "topology": Topology,
    "checks": Checks,
    "priority": Priority,
}


class RefinementOptions(Input):
    """How to refine. Every field has a default; a Refinement shows the effective values."""

    preset: Preset = Preset.DEFAULT
    iterations: int | None = Field(
        None, ge=1, le=10_000, description="Optimisation steps; unset: the preset's."
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="Same seed, same device: same result.")
    symmetry: Symmetry | None = Field(
        None,
        description="auto: the mirror plane is found on the coarse mesh; plane: it has the given normal and "
        "offset; none: the object has none. Unset: plane if a normal or an offset is given and for preset "
        "paper, else auto.",
    )
    symmetry_normal: tuple[Number, Number, Number] | None = Field(
        None,
        description="Normal of the object's mirror plane, world axes, any length but zero; unset: 0, 0, 1.",
    )
    symmetry_offset: Number | None = Field(
        None,
        description="Where the mirror plane cuts its normal, world units; unset: the coarse mesh decides.",
    )
    topology: Topology | None = Field(
        None,
        description="open: faces that cover the silhouette's background are removed; fixed: none are. Unset: "
        "fixed for a mesh with a texture and for preset paper, else open.",
    )
    correct_camera: bool = Field(
        False, description="The camera is a few degrees off: turn it about the object as the silhouette asks."
    )
    subdivide: bool = Field(
        False,
        description="Split the long edges of a mesh with few vertices, so that it can follow the silhouette; "
        "the refined mesh has the new vertices.",
    )
    silhouette_threshold: Number = Field(
        SILHOUETTE_THRESHOLD,
        gt=0.0,
        lt=1.0,
        description="An image with soft edges begins to be the object at this share of the way from its "
        "smallest to its largest level; one with two levels needs none.",
    )
    timeout_s: Positive | None = Field(
        None, description="Longest running time before DEADLINE_EXCEEDED; unset: the server's limit."
    )
    checks: Checks = Field(
        Checks.WARN,
        description="Inputs that look wrong: refuse them (strict), only what cannot be meant (warn), none.",
    )

    priority: Priority = Field(
        Priority.NORMAL, description="Sooner (high) or later (low) than others'; the API key sets the limit."
    )
    ignore_grey: int | None = Field(
        None,
        ge=0,
        le=65_535,
        description="Pixels of this level, as the file stores it, are unknown: a grey level (0 to 255, 65535 "
        "in 16 bits), the index in a palette, the luminance of a colour; alpha where alpha decides.",
    )

    @field_validator("symmetry_normal")
    @classmethod
    def _has_a_direction(cls, normal: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if normal and math.sqrt(sum(x * x for x in normal)) <= 1e-6:  # as in the engine's RefineConfig
            raise ValueError(f"expected a normal with a length of more than 1e-6, got {list(normal)}")
        return normal

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Self:
        given = self.symmetry_normal is not None or self.symmetry_offset is not None
        if given and self.symmetry in (Symmetry.AUTO, Symmetry.NONE):
            raise ValueError(
                f"expected no symmetry_normal and no symmetry_offset with symmetry {self.symmetry}, got one; "
                "leave symmetry out or say plane"
            )
        if self.correct_camera and self.preset is Preset.PAPER:
            raise ValueError(
                "expected no correct_camera with preset paper, whose cameras are exact, got true"
            )
        return self


class View(Input):
    """A further view of the same object, without its files."""

    camera: CameraSpec

    @field_validator("camera")
    @classmethod
    def _is_known(cls, camera: CameraSpec) -> CameraSpec:
        if isinstance(camera, EstimatedCamera):
            raise ValueError(
                "expected a camera that is known, got type estimate, which the first view may have"
            )
        return camera


class RefinementSpec(Input):
    """A request without its files: what the header of gRPC and the multipart fields of REST say."""

    camera: CameraSpec
    options: RefinementOptions = RefinementOptions()
    mesh_format: MeshFormat | None = None
    views: Sequence[View] = Field(
        (),
        max_length=MAX_VIEWS - 1,
        description="Further views, in the order of their files silhouette_2, silhouette_3, ...",
    )
    webhook: Webhook | None = Field(None, description="Who is told of the end.")
    metadata: Metadata = Field({}, description="Yours, to find it again: up to 20 pairs.")

    @model_validator(mode="after")
    def _one_projection(self) -> Self:
        cameras = [self.camera, *(view.camera for view in self.views)]
        kinds = {getattr(camera, "projection", "perspective") for camera in cameras}
        if len(kinds) > 1:
            raise ValueError(f"expected cameras of one kind of projection, got {' and '.join(sorted(kinds))}")
        return self


class ImageFiles(Input):
    """The image files of one view, in base64 or by their addresses: one of the two."""

    silhouette: Base64Bytes | None = Field(None, description="The silhouette image file.")
    silhouette_url: Url | None = Field(None, description="Or its https address.")
    ignore: Base64Bytes | None = Field(
        None, description="An image of the same size: where it shows an object, nothing is known."
    )
    ignore_url: Url | None = Field(None, description="Or its https address.")


class ViewRequest(View, ImageFiles):
    """A further view with its files."""


class RefinementRequest(RefinementSpec, ImageFiles):
    """The JSON body of `POST /v1/refinements`: a spec and its files."""

    mesh: Base64Bytes | None = Field(None, description="The coarse mesh file.")
    mesh_url: Url | None = Field(None, description="Or its https address.")
    views: Sequence[ViewRequest] = Field((), max_length=MAX_VIEWS - 1, description="Further views.")


# ---- what a server sends ----


class Output(BaseModel):
    """Base of everything a server sends: frozen, finite numbers; ignores the fields of a newer server."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class State(OpenEnum):
    """Where a Refinement is. A terminal state is written once and never changes, until the record expires.

    A state that only a newer version has is not terminal.
    """

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
        return self in (State.SUCCEEDED, State.FAILED, State.CANCELLED, State.EXPIRED)


class Progress(Output):
    """How far the optimisation is, at most twice a second."""

    iteration: int
    total: int
    percent: float
    eta_s: float | None = None
    losses: dict[str, float] = Field({}, description="Weighted terms by name, and `total`.")
    silhouette_iou: float = Field(0.0, description="2D IoU of the current iterate with the silhouette.")


class Outcome(OpenEnum):
    """What was handed back."""

    REFINED = "refined"  # the network's best iterate
    FITTED = "fitted"  # the mesh moved as a whole: what the network made of it agreed less
    KEPT = "kept"  # the coarse mesh as it came


class SilhouetteIou(Output):
    """2D IoU with the given silhouette."""

    before: float
    after: float


class MirrorPlane(Output):
    """The object's mirror plane, normal . x = offset."""

    normal: tuple[float, float, float] = Field(description="Unit length, world axes.")
    offset: float = Field(description="World units.")
    error: float | None = Field(
        None,
        description="Mean distance of the mirrored coarse mesh to itself, in its longest side; unset: the "
        "plane was given.",
    )


class CameraCorrection(Output):
    """How the cameras were corrected."""

    turn_degrees: float = Field(description="Angle by which they were turned about the object's centre.")


class CameraAlternative(Output):
    """A camera that may have seen the silhouette too, from another direction."""

    camera: CameraSpec = Field(description="To send with the same silhouette.")
    silhouette_iou: float = Field(description="2D IoU of the coarse mesh with the silhouette under it.")
    azimuth_degrees: float = Field(description="As of a look_at camera, but about the middle of the mesh.")
    elevation_degrees: float
    mirror_ambiguous: bool = Field(
        False,
        description="The silhouette is much the same from here: the estimate seen from the other "
        "side, or mirrored in the mesh's mirror plane.",
    )


class CameraEstimate(Output):
    """The camera that a silhouette says, with a mesh that is only roughly right."""

    camera: CameraSpec = Field(description="To send with the same silhouette.")
    silhouette_iou: float = Field(description="2D IoU of the coarse mesh with the silhouette under it.")
    azimuth_degrees: float = Field(description="As of a look_at camera, but about the middle of the mesh.")
    elevation_degrees: float
    alternatives: list[CameraAlternative] = Field([], description="Other directions, the likelier first.")


class MeshCounts(Output):
    """Vertices and faces: of the coarse mesh, of what was optimised, and of the refined mesh.

    Vertices at one position count once. A mesh of many vertices is optimised by way of a smaller one, one of
    few is subdivided where `subdivide` asks for it.
    """

    vertices: int = Field(description="Of the coarse mesh.")
    faces: int
    source_vertices: int = Field(description="Before those at one position were joined.")
    optimised_vertices: int
    optimised_faces: int
    refined_vertices: int
    refined_faces: int
    removed_faces: int = Field(description="Left out of the refined mesh: they cover holes.")


class Judgement(Output):
    """What a run says of its result, without knowing the truth; a Refinement shows all of it."""

    silhouette_iou: SilhouetteIou
    outcome: Outcome
    warnings: list[str] = []
    mirror_plane: MirrorPlane | None = None
    camera_correction: CameraCorrection | None = None
    camera: CameraEstimate | None = None
    mesh_counts: MeshCounts | None = None


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
    expires_at: datetime = Field(
        description="When the record and its artifacts are removed; before the end, not sooner than this."
    )
    queue_position: int | None = Field(None, description="Jobs ahead of this one; only while queued.")
    eta_s: float | None = Field(
        None, description="Seconds until it is expected to end; unset: it has ended, or nothing tells yet."
    )
    silhouette_iou: SilhouetteIou | None = None
    attempt: int = Field(0, description="How often a worker has started it.")
    checks: list[Finding] = Field([], description="What looked wrong with the inputs.")
    urls: RefinementUrls | None = None
    outcome: Outcome | None = None
    warnings: list[str] = Field([], description="About the input and the result, in words.")
    mirror_plane: MirrorPlane | None = Field(
        None, description="The one that was used; unset: none was, or there is no result."
    )
    camera_correction: CameraCorrection | None = Field(None, description="With `correct_camera` only.")
    metadata: dict[str, str] = Field({}, description="As it was submitted.")
    webhook_deliveries: list[WebhookDelivery] = Field([], description="Attempts so far, oldest first.")
    camera: CameraEstimate | None = Field(None, description="With a camera of type `estimate` only.")
    mesh_counts: MeshCounts | None = Field(None, description="How large the meshes were; with a result only.")

    @field_validator("options", mode="before")
    @classmethod
    def _accept_options_of_a_newer_server(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        known = {k: v for k, v in value.items() if k in RefinementOptions.model_fields}
        for name, kind in _KINDS.items():
            if isinstance(value := known.get(name), str):
                known[name] = of_newer_version(kind, value)
        return known


class Validation(Output):
    """What a refinement of the same request would find in its inputs. Nothing is refined or kept."""

    accepted: bool = Field(description="Whether it would be refined: no check refuses it.")
    silhouette_iou: float = Field(description="2D IoU of the coarse mesh with the silhouette.")
    warnings: list[str] = Field([], description="All that is to be said, also about the mesh file.")
    checks: list[Finding] = Field([], description="What looks wrong, as values.")

    @classmethod
    def of(cls, silhouette_iou: float, warnings: Iterable[str], checks: Iterable[Finding]) -> Self:
        """What comes of these findings."""
        found = list(checks)
        accepted = all(finding.severity is not Severity.REFUSED for finding in found)
        return cls(accepted=accepted, silhouette_iou=silhouette_iou, warnings=list(warnings), checks=found)


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
