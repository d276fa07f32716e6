"""An error as google.rpc.Status and back: what gRPC carries in the trailing metadata STATUS_KEY.

ErrorInfo has the reason, BadRequest the fields, RetryInfo when to try again, RequestInfo the request id.
"""

from __future__ import annotations

import math

from google.protobuf.any_pb2 import Any
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.rpc import code_pb2, error_details_pb2, status_pb2

from .errors import RefineError, error_class
from .models import FieldError

DOMAIN = "refine"
STATUS_KEY = "grpc-status-details-bin"


def to_status(error: RefineError, *, request_id: str | None = None) -> status_pb2.Status:
    """The status that a failed call ends with; its code is the one of the table."""
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=error.reason, domain=DOMAIN)]
    if error.errors:
        violations = [
            error_details_pb2.BadRequest.FieldViolation(field=field.pointer, description=field.detail)
            for field in error.errors
        ]
        details.append(error_details_pb2.BadRequest(field_violations=violations))
    if error.retry_after_s is not None:
        delay = Duration()
        delay.FromMilliseconds(math.ceil(1000 * error.retry_after_s))  # not sooner: it would be refused again
        details.append(error_details_pb2.RetryInfo(retry_delay=delay))
    if request_id or error.request_id:
        details.append(error_details_pb2.RequestInfo(request_id=request_id or error.request_id))
    return status_pb2.Status(
        code=code_pb2.Code.Value(error.status.grpc),
        message=error.detail,
        details=[_packed(detail) for detail in details],
    )


def from_status(status: status_pb2.Status) -> RefineError | None:
    """The error that a status tells; None if it has no reason of ours (a proxy's, or the library's own)."""
    info = error_details_pb2.ErrorInfo()
    request = error_details_pb2.BadRequest()
    retry = error_details_pb2.RetryInfo()
    sender = error_details_pb2.RequestInfo()
    unpacked = {
        type(part): any(detail.Unpack(part) for detail in status.details)
        for part in (info, request, retry, sender)
    }
    if not info.reason or info.domain != DOMAIN:
        return None
    delay_s = retry.retry_delay.ToMilliseconds() / 1000
    return error_class(info.reason)(
        status.message,
        reason=info.reason,
        errors=[FieldError(pointer=v.field, detail=v.description) for v in request.field_violations],
        retry_after_s=delay_s if unpacked[error_details_pb2.RetryInfo] else None,
        request_id=sender.request_id or None,
    )


def _packed(message: Message) -> Any:
    packed = Any()
    packed.Pack(message)
    return packed
