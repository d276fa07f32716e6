"""One call over either transport: who makes it, and the ids by which logs, answers and jobs find it."""

from __future__ import annotations

import re
import uuid
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Self

from refine_jobs.logs import LOG_FIELDS
from refine_proto.models import Priority

_REQUEST_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")
_TRACEPARENT = re.compile(r"(?!ff)[0-9a-f]{2}-(?!0{32})[0-9a-f]{32}-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")


@dataclass
class Call:
    """Made from the headers (HTTP) or metadata (gRPC); owner and job are filled in when they are known."""

    request_id: str
    traceparent: str | None = None  # W3C trace context, carried with the job to the worker
    owner: str = ""
    job_id: str | None = None
    max_priority: Priority = Priority.NORMAL

    @classmethod
    def of(cls, headers: Mapping[str, str]) -> Self:
        """The call with these headers, names in lower case. An id that is no id is replaced."""
        request_id = headers.get("x-request-id", "")
        traceparent = headers.get("traceparent", "")
        return cls(
            request_id=request_id if _REQUEST_ID.fullmatch(request_id) else uuid.uuid4().hex,
            traceparent=traceparent if _TRACEPARENT.fullmatch(traceparent) else None,
        )

    @property
    def trace_id(self) -> str | None:
        """The trace that the call is a part of."""
        return self.traceparent.split("-")[1] if self.traceparent else None

    def log_fields(self) -> dict[str, str]:
        """The ids that are known by now."""
        ids = {"request_id": self.request_id, "trace_id": self.trace_id, "job_id": self.job_id}
        return {name: value for name, value in ids.items() if value}


CALL: ContextVar[Call] = ContextVar("CALL")  # of the running task


def begin_call(headers: Mapping[str, str]) -> Call:
    """Make the call of the running task; its log lines carry its ids."""
    call = Call.of(headers)
    CALL.set(call)
    LOG_FIELDS.set(call.log_fields)
    return call
