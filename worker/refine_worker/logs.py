"""Logs as one JSON object per line on standard error, with the ids of the job at hand."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any

from refine_jobs.record import Job

_FIELDS: ContextVar[Mapping[str, str]] = ContextVar("log fields", default=MappingProxyType({}))
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime"}


class JsonFormatter(logging.Formatter):
    """time, level, logger, message, the fields of `log_fields`, those of `extra`, exception."""

    def __init__(self, process_fields: Mapping[str, str]) -> None:
        super().__init__()
        self._process_fields = process_fields

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **self._process_fields,
            **_FIELDS.get(),
            **{name: value for name, value in vars(record).items() if name not in _STANDARD},
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure_logs(**process_fields: str) -> None:
    """Send all logs and warnings of this process to standard error; every line has `process_fields`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(process_fields))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.captureWarnings(True)


@contextmanager
def log_fields(fields: Mapping[str, str]) -> Iterator[None]:
    """Inside, every line of this thread has these fields."""
    token = _FIELDS.set(fields)
    try:
        yield
    finally:
        _FIELDS.reset(token)


def fields_of(job: Job) -> dict[str, str]:
    """job_id, and where the request came with them request_id and trace_id (W3C trace context)."""
    fields = {"job_id": job.id, "attempt": str(job.attempt)}
    if job.request_id:
        fields["request_id"] = job.request_id
    if job.traceparent and job.traceparent.count("-") == 3:
        fields["trace_id"] = job.traceparent.split("-")[1]
    return fields
