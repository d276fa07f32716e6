"""Prometheus metrics: what this process counts, and what Redis knows of jobs and slots at a scrape."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from refine_jobs import keys
from refine_jobs.slots import SlotState, SlotStatus


class Metrics:
    """The counters of one service process; `transport` is rest or grpc."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self._calls = Histogram(
            "refine_call_seconds",
            "Calls by their duration; a stream counts when it ends.",
            ["transport", "method", "status"],
            registry=self.registry,
        )
        self._received = Counter(
            "refine_received_bytes", "Bytes of bodies received.", ["transport"], registry=self.registry
        )
        self._sent = Counter(
            "refine_sent_bytes", "Bytes of bodies sent.", ["transport"], registry=self.registry
        )
        self._watchers = Gauge(
            "refine_watchers", "Open event streams.", ["transport"], registry=self.registry
        )

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


def exposition(metrics: Metrics, counted: Mapping[str, int], slots: Iterable[SlotStatus]) -> bytes:
    """Everything in Prometheus' text format; `counted` is Health.metrics()."""
    of_jobs = CollectorRegistry()
    of_jobs.register(_Jobs(counted, list(slots)))
    return generate_latest(metrics.registry) + generate_latest(of_jobs)


class _Jobs(Collector):
    """Jobs and slots of the whole installation, the same from every service process."""

    def __init__(self, counted: Mapping[str, int], slots: list[SlotStatus]) -> None:
        self._counted, self._slots = counted, slots

    def collect(self) -> Iterator[Metric]:
        yield GaugeMetricFamily("refine_queued_jobs", "Jobs that wait.", self._counted["queued"])
        yield GaugeMetricFamily("refine_running_jobs", "Jobs that a slot has.", self._counted["running"])
        yield self._histogram("queue_s", "refine_queue_seconds", "From submission to the start.")
        yield self._histogram("run_s", "refine_run_seconds", "From the start to the end.")
        ended = CounterMetricFamily("refine_jobs", "Ended jobs.", labels=["state", "reason"])
        for name, value in self._counted.items():
            if name.startswith("jobs:"):
                _, state, reason = name.split(":")
                ended.add_metric([state, reason], value)
        yield ended
        alive = {slot.state for slot in self._slots}
        yield self._slot_gauge("refine_slots_live", "Worker slots that are alive.", alive)
        yield self._slot_gauge("refine_slots_busy", "Worker slots with a job.", {SlotState.BUSY})

    def _histogram(self, counted: str, name: str, text: str) -> Metric:
        buckets, total = [], 0
        for bound in [*keys.BUCKETS_S.split(), "inf"]:
            total += self._counted.get(f"{counted}:{bound}", 0)
            buckets.append(("+Inf" if bound == "inf" else str(float(bound)), total))
        seconds = self._counted.get(f"{counted}:sum_ms", 0) / 1000
        return HistogramMetricFamily(name, text, buckets, seconds)

    def _slot_gauge(self, name: str, text: str, states: set[SlotState]) -> Metric:
        gauge = GaugeMetricFamily(name, text, labels=["device"])
        for device in sorted({slot.device for slot in self._slots}):
            gauge.add_metric([device], sum(s.device == device and s.state in states for s in self._slots))
        return gauge
