"""Spans of OpenTelemetry where a program uses it; without it nothing is loaded and nothing costs anything.

The client joins the spans of its program. Processes of ours run in `tracing`, which needs the extra [otel]
and an endpoint by the usual OTEL_* variables. Between processes a span travels as W3C traceparent.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from opentelemetry import trace

_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_END_S = 3.0  # for what is left at the end
Value = str | int | float | bool

log = logging.getLogger(__name__)


class Kind(StrEnum):
    """What a span is to those around it; names of OpenTelemetry."""

    INTERNAL = "INTERNAL"
    CLIENT = "CLIENT"
    SERVER = "SERVER"
    PRODUCER = "PRODUCER"
    CONSUMER = "CONSUMER"


class Span:
    """One piece of work. Does nothing where no span is recorded."""

    def __init__(self, span: trace.Span | None) -> None:
        self._span = span

    @property
    def traceparent(self) -> str | None:
        """For whoever goes on with this work; None where there is no span."""
        return _traceparent(self._span) if self._span is not None else None

    def rename(self, name: str) -> None:
        """For what is known later only."""
        if self._span is not None:
            self._span.update_name(name)

    def set(self, attributes: Mapping[str, Value]) -> None:
        """Add attributes."""
        if self._span is not None:
            self._span.set_attributes(attributes)

    def fail(self, kind: str) -> None:
        """It went wrong; `kind` is a reason or the name of a class, never a text with a user's data."""
        if self._span is not None:
            self._span.set_attribute("error.type", kind)
            self._span.set_status(_trace().StatusCode.ERROR)

    def end(self) -> None:
        """It is over."""
        if self._span is not None:
            self._span.end()


@contextmanager
def tracing(service: str) -> Iterator[None]:
    """Export the spans of this process if the environment names an endpoint, the last ones at its end."""
    end = _start(service)
    try:
        yield
    finally:
        end()


def _start(service: str) -> Callable[[], None]:
    """What ends it."""
    if os.environ.get("OTEL_TRACES_EXPORTER") == "none" or not any(
        os.environ.get(name) for name in _ENDPOINTS
    ):
        return lambda: None
    try:
        from opentelemetry import trace
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        log.warning("spans are asked for (OTEL_EXPORTER_OTLP_ENDPOINT): pip install 'refine-mesh[otel]'")
        return lambda: None
    resource = Resource.create({"service.version": version("refine-mesh")})
    if str(resource.attributes["service.name"]).startswith("unknown_service"):  # no OTEL_SERVICE_NAME
        resource = resource.merge(Resource({"service.name": service}))
    provider = TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    trace.set_tracer_provider(provider)

    def end() -> None:
        # By itself it would wait up to 30 s for a collector that is away, and the process be killed for it.
        sending = threading.Thread(target=provider.shutdown, daemon=True)
        sending.start()
        sending.join(_END_S)

    return end


def start_span(
    name: str, kind: Kind, parent: str | None, attributes: Mapping[str, Value] | None = None
) -> Span:
    """Begin a span below a traceparent, or a trace of its own; the caller ends it."""
    trace = _trace()
    if trace is None:
        return Span(None)
    from opentelemetry.context import Context
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    context = Context()
    if parent is not None:
        context = TraceContextTextMapPropagator().extract({"traceparent": parent}, context)
    tracer = trace.get_tracer("refine")
    return Span(tracer.start_span(name, context, kind=trace.SpanKind[kind], attributes=attributes))


@contextmanager
def span(
    name: str, kind: Kind, parent: str | None, attributes: Mapping[str, Value] | None = None
) -> Iterator[Span]:
    """As start_span; it ends with the block, and fails with an exception."""
    started = start_span(name, kind, parent, attributes)
    try:
        yield started
    except BaseException as error:
        started.fail(type(error).__name__)
        raise
    finally:
        started.end()


@contextmanager
def call_span(name: str) -> Iterator[None]:
    """A call of the client, below the program's own span."""
    trace = _trace()
    if trace is None:
        yield
        return
    tracer = trace.get_tracer("refine")
    with tracer.start_as_current_span(name, kind=trace.SpanKind.CLIENT, record_exception=False):
        yield


def current_traceparent() -> str | None:
    """Of the program's span, for a call to a server; None where there is none."""
    trace = _trace()
    return None if trace is None else _traceparent(trace.get_current_span())


def _trace() -> Any:
    """OpenTelemetry's module, if this program has loaded it."""
    return sys.modules.get("opentelemetry.trace")


def _traceparent(span: trace.Span) -> str | None:
    context = span.get_span_context()
    if not context.is_valid:
        return None
    return f"00-{context.trace_id:032x}-{context.span_id:016x}-{context.trace_flags:02x}"
