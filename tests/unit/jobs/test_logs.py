"""The lines of the logs: the same words from service and worker."""

from __future__ import annotations

import io
import json
import logging
import sys
import warnings
from collections.abc import Iterator
from contextvars import copy_context
from typing import Any

import pytest

from refine_jobs.logs import LineRate, configure_logs, fields, log_fields
from refine_service.edge.call import begin_call

TRACE = "0af7651916cd43dd8448eb211c80319c"
log = logging.getLogger("a.logger")


@pytest.fixture
def stderr(monkeypatch: pytest.MonkeyPatch) -> Iterator[io.StringIO]:
    """Standard error of a process whose logs are configured; the test's own logging is put back."""
    root, written = logging.getLogger(), io.StringIO()
    monkeypatch.setattr(root, "handlers", [])
    level = root.level
    monkeypatch.setattr(sys, "stderr", written)
    configure_logs(slot="slot-1")
    yield written
    logging.captureWarnings(False)
    root.setLevel(level)


def lines(stderr: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stderr.getvalue().splitlines()]


def test_a_line_has_the_fields_of_process_context_and_call(stderr: io.StringIO) -> None:
    with log_fields({"job_id": "job-1"}):
        log.info("ended %s", "well", extra=fields(run_s=1.5))
    log.warning("idle", extra={"color_message": "what another library adds"})
    ended, idle = lines(stderr)
    assert ended.pop("time").endswith("+00:00")
    assert ended == {
        "level": "info",
        "logger": "a.logger",
        "message": "ended well",
        "slot": "slot-1",
        "job_id": "job-1",
        "run_s": 1.5,
    }
    assert set(idle) == {"time", "level", "logger", "message", "slot"}


def test_errors_and_warnings_are_lines_too(stderr: io.StringIO) -> None:
    try:
        raise ValueError("bad\nvalue")
    except ValueError:
        log.exception("failed")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn("careful", UserWarning, stacklevel=1)
    failed, warned = lines(stderr)
    assert "ValueError: bad\nvalue" in failed["traceback"]
    assert "UserWarning: careful" in warned["message"]


def test_the_ids_of_a_call_are_those_known_by_then(stderr: io.StringIO) -> None:
    def serve() -> None:
        call = begin_call({"x-request-id": "r-1", "traceparent": f"00-{TRACE}-b7ad6b7169203331-01"})
        log.info("begun")
        call.job_id = "job-2"
        log.info("found")

    copy_context().run(serve)
    begun, found = lines(stderr)
    assert (begun["request_id"], begun["trace_id"]) == ("r-1", TRACE)
    assert "job_id" not in begun
    assert found["job_id"] == "job-2"


def test_lines_without_end_are_left_out_and_told() -> None:
    now = 0.0
    rate = LineRate(3, clock=lambda: now)

    def written(level: int, count: int) -> list[str]:
        records = [logging.LogRecord("a", level, "", 0, "line %d", (n,), None) for n in range(count)]
        return [record.getMessage() for record in records if rate.filter(record)]

    assert written(logging.INFO, 100) == ["line 0", "line 1", "line 2"]
    assert len(written(logging.ERROR, 2)) == 2  # the others do not hide them
    now = 1.0
    assert written(logging.INFO, 1) == ["line 0 (97 lines before this one were left out)"]
