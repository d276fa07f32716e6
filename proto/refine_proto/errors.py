"""What can go wrong, as a tree with one table: reason -> title, HTTP status, gRPC status, retryable.

RefineError                  itself only for a reason that a newer server has
├── InvalidInput             the request's content; sending it again will not help
│   ├── FormatUnsupported, MeshInvalid, SilhouetteInvalid, CameraInvalid, ObjectOutOfView, OptionsInvalid
│   ├── PayloadTooLarge
│   └── IdempotencyKeyReused
├── Refused                  the request as such
│   ├── Unauthenticated, Forbidden, NotFound, Expired, Conflict
│   └── MethodNotAllowed, NotReady, RangeNotSatisfiable
├── Busy                     try again after `retry_after_s`
│   └── QuotaExceeded, QueueFull, Unavailable, Draining
├── CallFailed               the call itself failed; says nothing about a refinement
│   └── UploadTimeout, ServerError
└── JobFailed                accepted, but the refinement did not succeed
    ├── OutOfMemory, WorkerLost, DeadlineExceeded, Diverged, Internal
    └── Cancelled

The server raises these, and the SDK raises the same ones from a response (`from_problem`). What the worker
finds wrong with the files of an accepted refinement is InvalidInput: it is the files that have to change.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

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
    "FORBIDDEN": Status("Not allowed", 403, "PERMISSION_DENIED"),
    "NOT_FOUND": Status("Not found", 404, "NOT_FOUND"),
    "EXPIRED": Status("Expired", 410, "NOT_FOUND"),
    "CONFLICT": Status("Conflict with the current state", 409, "FAILED_PRECONDITION"),
    "METHOD_NOT_ALLOWED": Status("Method not allowed", 405, "UNIMPLEMENTED"),
    "NOT_READY": Status("Not ready yet", 406, "FAILED_PRECONDITION"),
    "RANGE_NOT_SATISFIABLE": Status("Range not satisfiable", 416, "OUT_OF_RANGE"),
    "QUOTA_EXCEEDED": Status("Quota exceeded", 429, "RESOURCE_EXHAUSTED", retryable=True),
    "QUEUE_FULL": Status("Queue full", 503, "UNAVAILABLE", retryable=True),
    "UNAVAILABLE": Status("Temporarily unavailable", 503, "UNAVAILABLE", retryable=True),
    "DRAINING": Status("Shutting down", 503, "UNAVAILABLE", retryable=True),
    "UPLOAD_TIMEOUT": Status("Upload too slow", 504, "DEADLINE_EXCEEDED"),
    "SERVER_ERROR": Status("Server error", 500, "INTERNAL"),
    "OUT_OF_MEMORY": Status("Out of memory", 500, "RESOURCE_EXHAUSTED"),
    "WORKER_LOST": Status("Worker lost", 500, "ABORTED", retryable=True),
    "DEADLINE_EXCEEDED": Status("Deadline exceeded", 504, "DEADLINE_EXCEEDED"),
    "DIVERGED": Status("Optimisation diverged", 500, "INTERNAL"),
    "INTERNAL": Status("Internal error", 500, "INTERNAL"),
    "CANCELLED": Status("Cancelled", 409, "CANCELLED"),
}


class RefineError(Exception):
    """Base of all errors of the contract.

    `detail` says what was expected, what came and what to do next; `retry_after_s` is when to try again;
    `reason` is that of the class unless another is given.
    """

    default_reason: ClassVar[str] = "SERVER_ERROR"

    def __init__(
        self,
        detail: str,
        *,
        reason: str | None = None,
        errors: Sequence[FieldError] = (),
        retry_after_s: float | None = None,
        request_id: str | None = None,
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.reason = reason or self.default_reason
        self.errors = tuple(errors)
        self.retry_after_s = retry_after_s
        self.request_id = request_id

    @property
    def status(self) -> Status:
        """The row of the table; that of SERVER_ERROR for a reason that only a newer server knows."""
        return TABLE.get(self.reason, TABLE["SERVER_ERROR"])

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
    default_reason = "INPUT_INVALID"


class FormatUnsupported(InvalidInput):
    default_reason = "FORMAT_UNSUPPORTED"


class MeshInvalid(InvalidInput):
    default_reason = "MESH_INVALID"


class SilhouetteInvalid(InvalidInput):
    default_reason = "SILHOUETTE_INVALID"


class CameraInvalid(InvalidInput):
    default_reason = "CAMERA_INVALID"


class ObjectOutOfView(InvalidInput):
    default_reason = "OBJECT_OUT_OF_VIEW"


class OptionsInvalid(InvalidInput):
    default_reason = "OPTIONS_INVALID"


class PayloadTooLarge(InvalidInput):
    default_reason = "PAYLOAD_TOO_LARGE"


class IdempotencyKeyReused(InvalidInput):
    default_reason = "IDEMPOTENCY_KEY_REUSED"


class Refused(RefineError):
    """Base of what is wrong with the request as such."""


class Unauthenticated(Refused):
    default_reason = "UNAUTHENTICATED"


class Forbidden(Refused):
    default_reason = "FORBIDDEN"


class NotFound(Refused):
    default_reason = "NOT_FOUND"


class Expired(Refused):
    default_reason = "EXPIRED"


class Conflict(Refused):
    default_reason = "CONFLICT"


class MethodNotAllowed(Refused):
    default_reason = "METHOD_NOT_ALLOWED"


class NotReady(Refused):
    default_reason = "NOT_READY"


class RangeNotSatisfiable(Refused):
    default_reason = "RANGE_NOT_SATISFIABLE"


class Busy(RefineError):
    """Base of what passes: try again after `retry_after_s`."""


class QuotaExceeded(Busy):
    default_reason = "QUOTA_EXCEEDED"


class QueueFull(Busy):
    default_reason = "QUEUE_FULL"


class Unavailable(Busy):
    default_reason = "UNAVAILABLE"


class Draining(Busy):
    default_reason = "DRAINING"


class CallFailed(RefineError):
    """Base of what ends a call without an answer to it."""


class UploadTimeout(CallFailed):
    default_reason = "UPLOAD_TIMEOUT"


class ServerError(CallFailed):
    default_reason = "SERVER_ERROR"


class JobFailed(RefineError):
    """Base of what ends an accepted refinement without a result."""


class OutOfMemory(JobFailed):
    default_reason = "OUT_OF_MEMORY"


class WorkerLost(JobFailed):
    default_reason = "WORKER_LOST"


class DeadlineExceeded(JobFailed):
    default_reason = "DEADLINE_EXCEEDED"


class Diverged(JobFailed):
    default_reason = "DIVERGED"


class Internal(JobFailed):
    default_reason = "INTERNAL"


class Cancelled(JobFailed):
    default_reason = "CANCELLED"


def _tree(root: type[RefineError]) -> Iterable[type[RefineError]]:
    for child in root.__subclasses__():
        yield child
        yield from _tree(child)


_BY_REASON: Mapping[str, type[RefineError]] = {
    cls.default_reason: cls for cls in _tree(RefineError) if "default_reason" in vars(cls)
}


def error_class(reason: str) -> type[RefineError]:
    """The class of a reason; RefineError for one that only a newer server knows."""
    return _BY_REASON.get(reason, RefineError)


def from_problem(problem: ProblemDetails, *, retry_after_s: float | None = None) -> RefineError:
    """The error that a response tells."""
    return error_class(problem.reason)(
        problem.detail,
        reason=problem.reason,
        errors=problem.errors,
        retry_after_s=retry_after_s,
        request_id=problem.request_id,
    )


# The first step of a pointer decides the reason; of a further view the third.
_REASON_OF_PART = {
    "camera": CameraInvalid,
    "options": OptionsInvalid,
    "mesh": MeshInvalid,
    "mesh_format": FormatUnsupported,
    "silhouette": SilhouetteInvalid,
    "ignore": SilhouetteInvalid,
}
_OF_A_VIEW = re.compile(r"^/views/\d+/|(?<=^/silhouette)_\d+$|(?<=^/ignore)_\d+$")


def from_validation(
    line_errors: Sequence[Mapping[str, Any]], *, under: Sequence[str | int] = ()
) -> InvalidInput:
    """The error for pydantic's `error.errors()`; `under` is where the validated value sits in the request."""
    wrong = list(complaints(line_errors, under))
    parts = {_part(pointer) for pointer, _ in wrong}
    error = _REASON_OF_PART.get(parts.pop(), InvalidInput) if len(parts) == 1 else InvalidInput
    fields = [FieldError(pointer=pointer, detail=sentence) for pointer, sentence in wrong]
    return error(in_one_line(wrong), errors=fields)


def _part(pointer: str) -> str:
    """The part of a request that a pointer is in; `camera` for a further view's camera."""
    first = _OF_A_VIEW.sub(lambda found: "/" if found[0].endswith("/") else "", pointer)
    return first.split("/")[1] if first else ""


_MAX_KEY_LENGTH = 255


def check_idempotency_key(key: str) -> None:
    """Raise InvalidInput unless `key` can be an idempotency key."""
    if not (0 < len(key) <= _MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        raise InvalidInput(
            f"expected an idempotency key of 1 to {_MAX_KEY_LENGTH} printable ASCII characters, "
            f"got {short(key)}"
        )
