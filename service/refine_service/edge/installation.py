"""Metrics of the whole installation, read from Redis at a scrape: the same from every service process."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from refine_jobs import keys
from refine_jobs.blobs import Space
from refine_jobs.health import Installation
from refine_jobs.slots import SlotState, SlotStatus
from refine_proto import errors
from refine_proto.models import State

_REASONS = (
    errors.FormatUnsupported,
    errors.MeshInvalid,
    errors.SilhouetteInvalid,
    errors.CameraInvalid,
    errors.ObjectOutOfView,
    errors.OutOfMemory,
    errors.WorkerLost,
    errors.DeadlineExceeded,
    errors.Diverged,
    errors.Internal,
)
# A counter that is not there before its first event hides that event from rate(): these begin at 0.
_ENDS = (
    *((State.SUCCEEDED, ""), (State.CANCELLED, "")),
    *((State.FAILED, reason.default_reason) for reason in _REASONS),
)
_CAUSES = ("lost", "returned")


def installation_exposition(counted: Installation, slots: Iterable[SlotStatus], space: Space | None) -> bytes:
    """In Prometheus' text format."""
    registry = CollectorRegistry()
    registry.register(_Installation(counted, list(slots), space))
    return generate_latest(registry)


class _Installation(Collector):
    """Jobs, slots, Redis and the disk of the blobs."""

    def __init__(self, counted: Installation, slots: list[SlotStatus], space: Space | None) -> None:
        self._counted, self._slots, self._space = counted, slots, space

    def collect(self) -> Iterator[Metric]:
        yield from self._jobs()
        yield from self._stores()

    def _jobs(self) -> Iterator[Metric]:
        counted = self._counted
        submitted = counted.counters.get("submitted:refinements", 0)
        yield CounterMetricFamily("refine_submitted_jobs", "Accepted refinements.", submitted)
        yield self._ended("jobs", "refine_jobs", "Ended refinements.")
        yield self._ended("questions", "refine_questions", "Ended questions: validations.")
        requeued = CounterMetricFamily(
            "refine_requeued_jobs", "Attempts that ended before their job did.", labels=["cause"]
        )
        for cause in _CAUSES:
            requeued.add_metric([cause], counted.counters.get(f"requeued:{cause}", 0))
        yield requeued
        yield GaugeMetricFamily("refine_queued_jobs", "Jobs that wait.", counted.queued)
        yield GaugeMetricFamily("refine_running_jobs", "Jobs that a slot has.", counted.running)
        yield GaugeMetricFamily(
            "refine_oldest_queued_job_age_seconds",
            "How long the job that has waited longest has been in the queue; 0 when none waits.",
            counted.oldest_queued_age_s,
        )
        yield self._histogram("queue_s", "refine_queue_seconds", "From entering the queue to the start.")
        yield self._histogram("run_s", "refine_run_seconds", "From the last start to the end of a job.")
        slots = GaugeMetricFamily("refine_slots", "Worker slots that are alive.", labels=["state"])
        for state, count in count_slots(self._slots).items():
            slots.add_metric([state], count)
        yield slots

    def _stores(self) -> Iterator[Metric]:
        counted, space = self._counted, self._space
        yield GaugeMetricFamily(
            "refine_redis_persistence_ok",
            "1 if the last writes of Redis to its disk succeeded, else 0.",
            counted.redis_persists,
        )
        yield GaugeMetricFamily(
            "refine_redis_used_memory_bytes", "Memory that Redis uses.", counted.redis_used_bytes
        )
        yield GaugeMetricFamily(
            "refine_redis_max_memory_bytes",
            "Memory that Redis may use; 0 without a limit.",
            counted.redis_max_bytes,
        )
        if space is not None:
            yield GaugeMetricFamily(
                "refine_blob_store_size_bytes", "Size of the disk of the blobs.", space.size_bytes
            )
            yield GaugeMetricFamily(
                "refine_blob_store_free_bytes", "Free bytes on the disk of the blobs.", space.free_bytes
            )

    def _ended(self, counted: str, name: str, text: str) -> Metric:
        ended = CounterMetricFamily(name, text, labels=["state", "reason"])
        counts = {(str(state), reason): 0 for state, reason in _ENDS}
        for name, value in self._counted.counters.items():
            kind, _, end = name.partition(":")
            if kind == counted:
                state, _, reason = end.partition(":")
                counts[state, reason] = value
        for labels, value in counts.items():
            ended.add_metric(labels, value)
        return ended

    def _histogram(self, counted: str, name: str, text: str) -> Metric:
        counters, buckets, total = self._counted.counters, [], 0
        for bound in [*keys.BUCKETS_S.split(), "inf"]:
            total += counters.get(f"{counted}:{bound}", 0)
            buckets.append(("+Inf" if bound == "inf" else str(float(bound)), total))
        return HistogramMetricFamily(name, text, buckets, counters.get(f"{counted}:sum_ms", 0) / 1000)


def count_slots(slots: Iterable[SlotStatus]) -> dict[SlotState, int]:
    """How many slots are in each state; every state is there."""
    counts = dict.fromkeys(SlotState, 0)
    for slot in slots:
        counts[slot.state] = counts.get(slot.state, 0) + 1
    return counts
