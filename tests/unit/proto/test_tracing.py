"""What tracing costs where nobody asks for it, and what is said where it cannot be had."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from refine_proto.tracing import Kind, current_traceparent, span


def run(program: str, **environment: str) -> str:
    """What the program prints; without OpenTelemetry's variables but for the given ones."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=own | environment, capture_output=True, text=True, check=True)
    return done.stdout + done.stderr


def test_nothing_is_loaded_unless_it_is_asked_for() -> None:
    program = """
import sys, refine_client
from refine_proto.tracing import current_traceparent, span, tracing
with tracing("refine-service"), span("work", "SERVER", None) as work:
    print(work.traceparent, current_traceparent(), [m for m in sys.modules if m.startswith("opentelemetry")])
"""
    assert run(program).strip() == "None None []"


def test_a_missing_extra_is_told_and_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "opentelemetry.py").write_text("raise ImportError('not installed')")
    program = """
import logging
from refine_proto.tracing import tracing
logging.basicConfig()
with tracing("refine-service"):
    print("goes on")
"""
    told = run(program, OTEL_EXPORTER_OTLP_ENDPOINT="http://127.0.0.1:9", PYTHONPATH=str(tmp_path))
    assert "goes on" in told
    assert "pip install 'refine-mesh[otel]'" in told


def test_a_span_that_nobody_records_takes_everything() -> None:
    with span("work", Kind.SERVER, "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01") as work:
        work.rename("other")
        work.set({"number": 1})
        work.fail("INTERNAL")
    assert current_traceparent() is None
