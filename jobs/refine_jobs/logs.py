"""The logs of service and worker: one JSON object a line on standard error, with the ids of what is done."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from .record import Job

_EXTRA = "fields"
LOG_FIELDS: ContextVar[Callable[[], Mapping[str, str]]] = ContextVar("fields of a line", default=dict)
"""Tells the fields of every line of this thread or task: a function, for ids become known on the way."""


class JsonFormatter(logging.Formatter):
    """time, level, logger, message; fields of the process, of LOG_FIELDS and of `fields`; traceback."""

    def __init__(self, process_fields: Mapping[str, str]) -> None:
        super().__init__()
        self._process_fields = process_fields

    def format(self, record: logging.LogRecord) -> str:
        """One line of JSON."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **self._process_fields,
            **LOG_FIELDS.get()(),
            **getattr(record, _EXTRA, {}),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class LineRate(logging.Filter):
    """Lets so many lines through in a second, of errors and warnings and of the rest; tells what it left out.

    A server that strangers can reach shall not fill its disk with what they did.
    """

    def __init__(self, lines_per_s: int, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._limit, self._clock = lines_per_s, clock
        self._second = 0
        self._counts: Counter[bool] = Counter()  # of this second, by whether they are warnings

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line is written."""
        second = int(self._clock())
        if second != self._second:
            left_out = sum(max(0, count - self._limit) for count in self._counts.values())
            self._second, self._counts = second, Counter()
            if left_out:
                record.msg = f"{record.getMessage()} ({left_out} lines before this one were left out)"
                record.args = ()
        urgent = record.levelno >= logging.WARNING
        self._counts[urgent] += 1
        return self._counts[urgent] <= self._limit


def configure_logs(*, lines_per_s: int = 1000, **process_fields: str) -> None:
    """Send all logs and warnings of this process to standard error; every line has `process_fields`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.addFilter(LineRate(lines_per_s))
    handler.setFormatter(JsonFormatter(process_fields))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.captureWarnings(True)


def fields(**values: Any) -> dict[str, Any]:
    """For `extra` of a logging call: fields of this one line. What other libraries put there is not shown."""
    return {_EXTRA: values}


@contextmanager
def log_fields(fields: Mapping[str, str]) -> Iterator[None]:
    """Inside, every line of this thread or task has these fields."""
    token = LOG_FIELDS.set(lambda: fields)
    try:
        yield
    finally:
        LOG_FIELDS.reset(token)


def fields_of(job: Job) -> dict[str, str]:
    """job_id, and where the request came with them request_id and trace_id (W3C trace context)."""
    found = {"job_id": job.id, "attempt": str(job.attempt)}
    if job.request_id:
        found["request_id"] = job.request_id
    if job.traceparent and job.traceparent.count("-") == 3:
        found["trace_id"] = job.traceparent.split("-")[1]
    return found
