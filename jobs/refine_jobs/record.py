"""The record of a job: what the hash in Redis holds, and what of it the contract shows."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from refine_proto.models import (
    Artifact,
    CameraCorrection,
    CameraEstimate,
    Event,
    EventType,
    Finding,
    MeshCounts,
    MirrorPlane,
    Outcome,
    ProblemDetails,
    Progress,
    Refinement,
    RefinementSpec,
    SilhouetteIou,
    State,
    WebhookDelivery,
)

from .blobs import Blob

_OF_RESULT = (
    "silhouette_iou",
    "warnings",
    "mirror_plane",
    "camera_correction",
    "camera",
    "mesh_counts",
    "checks",
    "answer",
)
_OF_EDGE = ("spec", "mesh", "silhouette", "more_files", "webhook_deliveries")
_JSON = (*_OF_EDGE, "progress", "error", "artifacts", *_OF_RESULT)
Entry = tuple[str, Mapping[str, str]]  # of a stream: id, fields
_TIMES = ("created_ms", "started_ms", "finished_ms", "expires_ms")

log = logging.getLogger(__name__)


class Task(StrEnum):
    """What a worker does with a job. All but a refinement are questions: answered soon, and never listed."""

    REFINE = "refine"
    VALIDATE = "validate"
    ESTIMATE = "estimate"


class Submission(BaseModel):
    """What the edge hands over once all files are in the blob store."""

    model_config = ConfigDict(frozen=True)

    id: str
    owner: str
    spec: RefinementSpec
    mesh: Blob
    silhouette: Blob
    task: Task = Task.REFINE
    more_files: Mapping[str, Blob] = {}  # by their names in the request: ignore, silhouette_2, ...
    idempotency_key: str | None = None
    request_id: str | None = None
    traceparent: str | None = None


class Job(BaseModel):
    """A job, whole: the worker's view of a Refinement."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: str
    owner: str
    state: State
    attempt: int
    spec: Mapping[str, Any]  # a RefinementSpec, checked at the edge: only who refines reads it again
    mesh: Blob
    silhouette: Blob
    task: Task = Task.REFINE
    pool: str | None = None  # whose workers it is for; None: of a former version
    more_files: Mapping[str, Blob] = {}
    created_at: datetime
    expires_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    slot: str | None = None
    progress: Progress | None = None
    error: ProblemDetails | None = None
    artifacts: tuple[Artifact, ...] = ()
    silhouette_iou: SilhouetteIou | None = None
    outcome: Outcome | None = None
    warnings: tuple[str, ...] = ()
    mirror_plane: MirrorPlane | None = None
    camera_correction: CameraCorrection | None = None
    camera: CameraEstimate | None = None
    mesh_counts: MeshCounts | None = None
    checks: tuple[Finding, ...] = ()
    answer: Mapping[str, Any] | None = None  # to a question
    webhook_deliveries: tuple[WebhookDelivery, ...] = ()
    request_id: str | None = None
    traceparent: str | None = None
    sequence: int = 0  # of its last event
    cost_ms: int | None = None  # estimated, see share.py; None: of a former version

    @classmethod
    def decode(cls, fields: Mapping[str, str]) -> Self:
        """From the fields of the hash."""
        values: dict[str, Any] = dict(fields)
        for name in _JSON:
            if name in values:
                values[name] = json.loads(values[name])
        for name in _TIMES:
            if name in values:
                values[name.replace("_ms", "_at")] = instant(values[name])
        return cls.model_validate(values)

    @classmethod
    def read(cls, fields: Mapping[str, str]) -> Self | None:
        """As decode; None if there is no job, or one that only a newer version can read, which is logged."""
        if "spec" not in fields:
            return None
        try:
            return cls.decode(fields)
        except ValidationError as error:
            log.warning("job %s cannot be read: %s", fields["id"], error)
            return None

    @property
    def timeout_s(self) -> float:
        """Longest run of one attempt; submit has filled it in."""
        return float(self.spec["options"]["timeout_s"])

    @property
    def size_bytes(self) -> int:
        """Of all files."""
        return sum(blob.size_bytes for blob in (self.mesh, self.silhouette, *self.more_files.values()))

    def refinement(self, queue_position: int | None = None, eta_s: float | None = None) -> Refinement:
        """What the contract shows; the edge adds URLs."""
        return Refinement(
            id=self.id,
            state=self.state,
            options=self.spec["options"],
            metadata=self.spec.get("metadata", {}),
            progress=self.progress,
            error=self.error,
            artifacts=list(self.artifacts),
            created_at=self.created_at,
            started_at=self.started_at,
            finished_at=self.finished_at,
            expires_at=self.expires_at,
            queue_position=queue_position,
            eta_s=eta_s,
            silhouette_iou=self.silhouette_iou,
            checks=list(self.checks),
            attempt=self.attempt,
            outcome=self.outcome,
            warnings=list(self.warnings),
            mirror_plane=self.mirror_plane,
            camera_correction=self.camera_correction,
            webhook_deliveries=list(self.webhook_deliveries),
            camera=self.camera,
            mesh_counts=self.mesh_counts,
        )


def instant(milliseconds: str | int) -> datetime:
    """Milliseconds since 1970 as a time in UTC."""
    return datetime.fromtimestamp(int(milliseconds) / 1000, UTC)


def encode(values: Mapping[str, Any]) -> list[str]:
    """Field, value, ... of a hash; models and blobs as JSON, None left out."""
    return [word for name, value in values.items() if value is not None for word in (name, _text(value))]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else to_json(value)


def to_json(value: Any) -> str:
    """A model, a blob or a sequence of models as JSON."""
    return json.dumps(value, default=_plain, separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, RefinementSpec):  # older workers refuse fields that they do not know
        return {name: part for name, part in _dump(value).items() if part not in ([], {})}
    return _dump(value) if isinstance(value, BaseModel) else vars(value)


def _dump(model: BaseModel) -> dict[str, Any]:
    return model.model_dump(mode="json", exclude_none=True)


def decode_event(entry: Entry) -> Event | None:
    """From an entry of the stream; None for a type that only a newer version writes. Raises ValueError."""
    _, fields = entry
    if fields.get("type") not in list(EventType):
        return None
    progress = fields.get("progress")
    return Event.model_validate(
        {
            "sequence": sequence_of(entry),
            "type": fields["type"],
            "time": instant(fields.get("time", "")),
            "state": fields.get("state"),
            "progress": json.loads(progress) if progress else None,
        }
    )


def sequence_of(entry: Entry) -> int:
    """The number of the event, from its id <sequence>-0."""
    return int(entry[0].partition("-")[0])


def pairs(flat: Sequence[str]) -> dict[str, str]:
    """What a script's HGETALL returns, as a dictionary."""
    return dict(zip(flat[::2], flat[1::2], strict=True))
