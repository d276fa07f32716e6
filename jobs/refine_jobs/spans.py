"""Spans of a job's way through the queue, named by OpenTelemetry's conventions for messaging.

    POST /v1/refinements  ->  enqueue refine-POOL  ->  process refine-POOL  ->  fetch, read, refine, store

The record carries the traceparent of the second to the worker. Every attempt has a `process` of its own.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from refine_proto.tracing import Kind, Span, Value, span

from .record import Job


def enqueue_span(queue: str, job_id: str, parent: str | None) -> AbstractContextManager[Span]:
    """Of the step that makes an upload a queued job."""
    return span(f"enqueue {queue}", Kind.PRODUCER, parent, _message(queue, job_id, "send", "enqueue"))


def process_span(queue: str, job: Job) -> AbstractContextManager[Span]:
    """Of one attempt."""
    attributes = {**_message(queue, job.id, "process", "process"), "refine.attempt": job.attempt}
    return span(f"process {queue}", Kind.CONSUMER, job.traceparent, attributes)


def _message(queue: str, job_id: str, operation_type: str, operation: str) -> dict[str, Value]:
    return {
        "messaging.system": "rq",
        "messaging.destination.name": queue,
        "messaging.operation.type": operation_type,
        "messaging.operation.name": operation,
        "messaging.message.id": job_id,
    }
