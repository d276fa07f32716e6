"""Logs as one JSON object a line on standard error, with the ids of the call that wrote them."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Any

from .edge.call import CALL

_FIELDS = "fields"  # of `extra`: more values for the line


def set_up_logging(level: int = logging.INFO) -> None:
    """Send everything that is logged in this process through the JSON formatter."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)


def fields(**values: Any) -> dict[str, Any]:
    """For `extra` of a logging call: values with names of their own in the line."""
    return {_FIELDS: values}


class JsonFormatter(logging.Formatter):
    """time, level, logger, message; request, trace and job id where there is a call; fields; traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """One line of JSON."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        call = CALL.get(None)
        if call is not None:
            ids = {"request_id": call.request_id, "trace_id": call.trace_id, "job_id": call.job_id}
            line |= {name: value for name, value in ids.items() if value}
        line |= getattr(record, _FIELDS, {})
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)
