"""One trace from a program's call of the SDK to the engine's stages, as a collector sees it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from serve_process import serve

pytest.importorskip("opentelemetry.sdk", reason="the extra [otel] is not installed")

from span_collector import CollectedSpan, Collector, collect

PROGRAM = """
import asyncio, json, sys
from pathlib import Path
from opentelemetry import trace
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from refine_client import AsyncRefineClient, RefineClient

server, sample, face = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
provider = TracerProvider(resource=Resource({"service.name": "program"}))
provider.add_span_processor(SimpleSpanProcessor(OTLPSpanExporter()))
trace.set_tracer_provider(provider)
given = (sample / "coarse.obj", sample / "silhouette.png", json.loads((sample / "camera.json").read_text()))

async def refine():
    async with AsyncRefineClient(server) as client:
        await client.wait((await client.submit(*given, {"iterations": 2})).id)

with trace.get_tracer("program").start_as_current_span("a program's work"):
    if face == "async":
        asyncio.run(refine())
    else:
        with RefineClient(server) as client:
            client.wait(client.submit(*given, {"iterations": 2}).id)
"""
SAMPLE = Path(__file__).parents[2] / "examples/samples/chair"
QUEUE = "refine-default"
LINE = ["a program's work", "create refinement", f"enqueue {QUEUE}", f"process {QUEUE}"]
STAGES = ["fetch", "read", "refine", "store"]


def of_the_job(collector: Collector, trace_id: str, create: str) -> dict[str, CollectedSpan]:
    """By name; a trace has the program's later calls too."""
    found = [s for s in collector.spans if s.trace_id == trace_id and s.name in {*LINE, *STAGES, create}]
    names = [span.name for span in found]
    assert len(names) == len(set(names)), names
    return {span.name: span for span in found}


def test_one_trace_from_the_sdk_to_the_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with collect() as collector:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", collector.url)
        monkeypatch.delenv("OTEL_SERVICE_NAME", raising=False)
        with serve(tmp_path) as served:
            for server, face in ((served.url, "sync"), (f"grpc://{served.grpc_address}", "async")):
                command = [sys.executable, "-c", PROGRAM, server, str(SAMPLE), face]
                subprocess.run(command, check=True, env=os.environ)
            served.process.send_signal(signal.SIGTERM)
            assert served.process.wait(90) == 0  # what is left is sent at the end
        works = collector.named("a program's work")
        assert len(works) == 2
        for work, create in zip(
            works, ("POST /v1/refinements", "refine.v1.Refinements/CreateRefinement"), strict=True
        ):
            spans = of_the_job(collector, work.trace_id, create)
            line = [*LINE[:2], create, *LINE[2:]]
            for parent, child in pairwise(line):
                assert spans[child].parent_id == spans[parent].id, (parent, child)
            assert [spans[stage].parent_id for stage in STAGES] == [spans[f"process {QUEUE}"].id] * 4
            assert [(spans[name].service, spans[name].kind) for name in [*line, "refine"]] == [
                ("program", "INTERNAL"),
                ("program", "CLIENT"),
                ("refine-service", "SERVER"),
                ("refine-service", "PRODUCER"),
                ("refine-worker", "CONSUMER"),
                ("refine-worker", "INTERNAL"),
            ]
            sent, processed = spans[f"enqueue {QUEUE}"].attributes, spans[f"process {QUEUE}"].attributes
            assert sent["messaging.message.id"] == processed["messaging.message.id"]
            assert (sent["messaging.operation.type"], processed["messaging.operation.type"]) == (
                "send",
                "process",
            )
            assert sent["messaging.destination.name"] == QUEUE
            assert processed["refine.outcome"] == "succeeded"
            assert not any(span.failed for span in spans.values())
