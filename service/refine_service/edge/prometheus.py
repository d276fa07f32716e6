"""Prometheus metrics of this process: what it has counted itself. installation.py has those of all jobs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest

from refine_jobs.build import register_build

# From a lookup to an event stream of an hour.
_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600, 1800, 3600)


class Metrics:
    """The counters of one service process; `transport` is rest or grpc."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        register_build(self._registry)
        self._calls = Histogram(
            "refine_call_seconds",
            "Calls by their duration; a stream counts when it ends.",
            ["transport", "method", "status"],
            registry=self._registry,
            buckets=_BUCKETS_S,
        )
        self._received = Counter(
            "refine_received_bytes", "Bytes of bodies received.", ["transport"], registry=self._registry
        )
        self._sent = Counter(
            "refine_sent_bytes", "Bytes of bodies sent.", ["transport"], registry=self._registry
        )
        self._watchers = Gauge(
            "refine_watchers", "Open event streams.", ["transport"], registry=self._registry
        )
        for transport in ("rest", "grpc"):  # there from the start, with 0
            for metric in (self._received, self._sent, self._watchers):
                metric.labels(transport)

    def observe(self, transport: str, method: str, status: str, seconds: float) -> None:
        """Count one ended call."""
        self._calls.labels(transport, method, status).observe(seconds)

    def count_bytes(self, transport: str, received: int = 0, sent: int = 0) -> None:
        """Count bytes of bodies."""
        self._received.labels(transport).inc(received)
        self._sent.labels(transport).inc(sent)

    @contextmanager
    def watching(self, transport: str) -> Iterator[None]:
        """Count a watcher while inside."""
        with self._watchers.labels(transport).track_inprogress():
            yield

    def exposition(self) -> bytes:
        """In Prometheus' text format."""
        return generate_latest(self._registry)
