"""What can go wrong, as a tree with one table: reason -> title, HTTP status, gRPC status, retryable.

RefineError
├── InvalidInput             the request's content; sending it again will not help
│   ├── FormatUnsupported, MeshInvalid, SilhouetteInvalid, CameraInvalid, ObjectOutOfView, OptionsInvalid
│   ├── PayloadTooLarge
│   └── IdempotencyKeyReused
├── Refused                  the request as such
│   ├── Unauthenticated, NotFound, Expired, Conflict
│   └── MethodNotAllowed, RangeNotSatisfiable
├── Busy                     try again after `retry_after_s`
│   └── QuotaExceeded, QueueFull, Unavailable, Draining
└── JobFailed                accepted, but the refinement did not succeed
    ├── OutOfMemory, WorkerLost, DeadlineExceeded, Diverged, Internal
    └── Cancelled

The server raises these, and the SDK raises the same ones from a response (`from_problem`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .models import FieldError, ProblemDetails
from .strict import complaints, in_one_line, short


@dataclass(frozen=True)
class Status:
    """How a reason is told: over HTTP, over gRPC (a name of grpc.StatusCode), and whether to try again."""

    title: str
    http: int
    grpc: str
    retryable: bool = False


TABLE: Mapping[str, Status] = {
    "INPUT_INVALID": Status("Invalid request", 422, "INVALID_ARGUMENT"),
    "MESH_INVALID": Status("Invalid mesh", 422, "INVALID_ARGUMENT"),
    "SILHOUETTE_INVALID": Status("Invalid silhouette", 422, "INVALID_ARGUMENT"),
    "CAMERA_INVALID": Status("Invalid camera", 422, "INVALID_ARGUMENT"),
    "OBJECT_OUT_OF_VIEW": Status("Object out of view", 422, "INVALID_ARGUMENT"),
    "OPTIONS_INVALID": Status("Invalid options", 422, "INVALID_ARGUMENT"),
    "FORMAT_UNSUPPORTED": Status("Unsupported format", 415, "INVALID_ARGUMENT"),
    "PAYLOAD_TOO_LARGE": Status("Payload too large", 413, "RESOURCE_EXHAUSTED"),
    "IDEMPOTENCY_KEY_REUSED": Status("Idempotency key reused", 422, "ALREADY_EXISTS"),
    "UNAUTHENTICATED": Status("Not signed in", 401, "UNAUTHENTICATED"),
    "NOT_FOUND": Status("Not found", 404, "NOT_FOUND"),
    "EXPIRED": Status("Expired", 410, "NOT_FOUND"),
    "CONFLICT": Status("Conflict with the current state", 409, "FAILED_PRECONDITION"),
    "METHOD_NOT_ALLOWED": Status("Method not allowed", 405, "UNIMPLEMENTED"),
    "RANGE_NOT_SATISFIABLE": Status("Range not satisfiable", 416, "OUT_OF_RANGE"),
    "QUOTA_EXCEEDED": Status("Quota exceeded", 429, "RESOURCE_EXHAUSTED", retryable=True),
    "QUEUE_FULL": Status("Queue full", 503, "UNAVAILABLE", retryable=True),
    "UNAVAILABLE": Status("Temporarily unavailable", 503, "UNAVAILABLE", retryable=True),
    "DRAINING": Status("Shutting down", 503, "UNAVAILABLE", retryable=True),
    "OUT_OF_MEMORY": Status("Out of memory", 500, "RESOURCE_EXHAUSTED"),
    "WORKER_LOST": Status("Worker lost", 500, "ABORTED", retryable=True),
    "DEADLINE_EXCEEDED": Status("Deadline exceeded", 504, "DEADLINE_EXCEEDED"),
    "DIVERGED": Status("Optimisation diverged", 500, "INTERNAL"),
    "INTERNAL": Status("Internal error", 500, "INTERNAL"),
    "CANCELLED": Status("Cancelled", 409, "CANCELLED"),
}


class RefineError(Exception):
    """Base of all errors of the contract.

    `detail` says what was expected, what came and what to do next; `retry_after_s` is when to try again.
    """

    reason = "INTERNAL"

    def __init__(
        self,
        detail: str,
        *,
        errors: Sequence[FieldError] = (),
        retry_after_s: float | None = None,
        request_id: str | None = None,
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.errors = tuple(errors)
        self.retry_after_s = retry_after_s
        self.request_id = request_id

    @property
    def status(self) -> Status:
        """The row of the table; that of INTERNAL for a reason that only a newer server knows."""
        return TABLE.get(self.reason, TABLE["INTERNAL"])

    @property
    def retryable(self) -> bool:
        """Whether the same request may succeed later."""
        return self.status.retryable

    def problem(self, *, request_id: str | None = None, instance: str | None = None) -> ProblemDetails:
        """This error as RFC 9457 problem details."""
        return ProblemDetails(
            title=self.status.title,
            status=self.status.http,
            detail=self.detail,
            instance=instance,
            reason=self.reason,
            request_id=request_id or self.request_id,
            retryable=self.retryable,
            errors=list(self.errors),
        )


class InvalidInput(RefineError):
    reason = "INPUT_INVALID"


class FormatUnsupported(InvalidInput):
    reason = "FORMAT_UNSUPPORTED"


class MeshInvalid(InvalidInput):
    reason = "MESH_INVALID"


class SilhouetteInvalid(InvalidInput):
    reason = "SILHOUETTE_INVALID"


class CameraInvalid(InvalidInput):
    reason = "CAMERA_INVALID"


class ObjectOutOfView(InvalidInput):
    reason = "OBJECT_OUT_OF_VIEW"


class OptionsInvalid(InvalidInput):
    reason = "OPTIONS_INVALID"


class PayloadTooLarge(InvalidInput):
    reason = "PAYLOAD_TOO_LARGE"


class IdempotencyKeyReused(InvalidInput):
    reason = "IDEMPOTENCY_KEY_REUSED"


class Refused(RefineError):
    """Base of what is wrong with the request as such."""


class Unauthenticated(Refused):
    reason = "UNAUTHENTICATED"


class NotFound(Refused):
    reason = "NOT_FOUND"


class Expired(Refused):
    reason = "EXPIRED"


class Conflict(Refused):
    reason = "CONFLICT"


class MethodNotAllowed(Refused):
    reason = "METHOD_NOT_ALLOWED"


class RangeNotSatisfiable(Refused):
    reason = "RANGE_NOT_SATISFIABLE"


class Busy(RefineError):
    """Base of what passes: try again after `retry_after_s`."""


class QuotaExceeded(Busy):
    reason = "QUOTA_EXCEEDED"


class QueueFull(Busy):
    reason = "QUEUE_FULL"


class Unavailable(Busy):
    reason = "UNAVAILABLE"


class Draining(Busy):
    reason = "DRAINING"


class JobFailed(RefineError):
    """Base of what ends an accepted refinement without a result."""


class OutOfMemory(JobFailed):
    reason = "OUT_OF_MEMORY"


class WorkerLost(JobFailed):
    reason = "WORKER_LOST"


class DeadlineExceeded(JobFailed):
    reason = "DEADLINE_EXCEEDED"


class Diverged(JobFailed):
    reason = "DIVERGED"


class Internal(JobFailed):
    reason = "INTERNAL"


class Cancelled(JobFailed):
    reason = "CANCELLED"


def _tree(root: type[RefineError]) -> Iterable[type[RefineError]]:
    for child in root.__subclasses__():
        yield child
        yield from _tree(child)


_BY_REASON: Mapping[str, type[RefineError]] = {
    cls.reason: cls for cls in _tree(RefineError) if "reason" in vars(cls)
}


def error_class(reason: str) -> type[RefineError]:
    """The class of a reason; RefineError for one that only a newer server knows."""
    return _BY_REASON.get(reason, RefineError)


def from_problem(problem: ProblemDetails, *, retry_after_s: float | None = None) -> RefineError:
    """The error that a response tells."""
    error = error_class(problem.reason)(
        problem.detail, errors=problem.errors, retry_after_s=retry_after_s, request_id=problem.request_id
    )
    error.reason = problem.reason
    return error


# The first step of a pointer decides the reason.
_REASON_OF_PART = {
    "camera": CameraInvalid,
    "options": OptionsInvalid,
    "mesh": MeshInvalid,
    "mesh_format": FormatUnsupported,
    "silhouette": SilhouetteInvalid,
}


def from_validation(
    line_errors: Sequence[Mapping[str, Any]], *, under: Sequence[str | int] = ()
) -> InvalidInput:
    """The error for pydantic's `error.errors()`; `under` is where the validated value sits in the request."""
    wrong = list(complaints(line_errors, under))
    parts = {pointer.split("/")[1] if pointer else "" for pointer, _ in wrong}
    error = _REASON_OF_PART.get(parts.pop(), InvalidInput) if len(parts) == 1 else InvalidInput
    fields = [FieldError(pointer=pointer, detail=sentence) for pointer, sentence in wrong]
    return error(in_one_line(wrong), errors=fields)


_MAX_KEY_LENGTH = 255


def check_idempotency_key(key: str) -> None:
    """Raise InvalidInput unless `key` can be an idempotency key."""
    if not (0 < len(key) <= _MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        raise InvalidInput(
            f"expected an idempotency key of 1 to {_MAX_KEY_LENGTH} printable ASCII characters, "
            f"got {short(key)}"
        )
