"""Prometheus metrics of one worker: what its slots are and have done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from refine_jobs.build import register_build
from refine_jobs.slots import SlotState

from .gpu_memory import gpu_memory
from .messages import Phase
from .reports import AttemptEnded, EngineEnd, EngineEnded, EngineStarted, Outcome, Report
from .slot_process import STOPPED, Ending, SlotProcess

_BUCKETS_S = (0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600, 1200, 1800, 3600)


class WorkerMetrics:
    """Counts reports; `slots` are read at a scrape. Safe to use from several threads."""

    def __init__(self, slots: Sequence[SlotProcess]) -> None:
        self._registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        register_build(registry)
        self._gpus: dict[str, str] = {}  # device -> UUID
        registry.register(_Now(slots, self._gpus))
        self._slot_restarts = Counter(
            "refine_worker_slot_restarts",
            "Slot processes that were started again.",
            ["device", "cause"],
            registry=registry,
        )
        self._engine_starts = Counter(
            "refine_worker_engine_starts", "Engine processes that became warm.", ["device"], registry=registry
        )
        self._engine_restarts = Counter(
            "refine_worker_engine_restarts",
            "Engine processes whose slot needed a new one.",
            ["device", "cause"],
            registry=registry,
        )
        self._engine_start = Histogram(
            "refine_worker_engine_start_seconds",
            "From the start of an engine process to warm.",
            ["device"],
            registry=registry,
            buckets=_BUCKETS_S,
        )
        self._stages = Histogram(
            "refine_worker_stage_seconds",
            "Stages of attempts by their duration.",
            ["stage", "preset", "device"],
            registry=registry,
            buckets=_BUCKETS_S,
        )
        self._attempts = Counter(
            "refine_worker_attempts", "Attempts by how they ended.", ["device", "outcome"], registry=registry
        )
        self._start_at_zero({slot.plan.device for slot in slots})

    def _start_at_zero(self, devices: set[str]) -> None:
        """A counter that is not there before its first event hides that event from rate()."""
        for device in devices:
            self._engine_starts.labels(device)
            for ending in Ending:
                self._slot_restarts.labels(device, ending)
            for cause in EngineEnd:
                self._engine_restarts.labels(device, cause)
            for outcome in Outcome:
                self._attempts.labels(device, outcome)

    def count(self, device: str, report: Report) -> None:
        """Count a report of a slot on `device`."""
        if isinstance(report, EngineStarted):
            self._engine_starts.labels(device).inc()
            self._engine_start.labels(device).observe(report.seconds)
            if report.gpu_uuid:
                self._gpus[device] = report.gpu_uuid
        elif isinstance(report, EngineEnded):
            self._engine_restarts.labels(device, report.cause).inc()
        elif isinstance(report, AttemptEnded):
            self._attempts.labels(device, report.outcome).inc()
            for stage in Phase:
                if stage in report.stages:
                    self._stages.labels(stage, report.preset, device).observe(report.stages[stage])

    def count_restart(self, device: str, ending: Ending) -> None:
        """Count a slot process that ended by itself or was killed because it hung."""
        self._slot_restarts.labels(device, ending).inc()

    def exposition(self) -> bytes:
        """In Prometheus' text format."""
        return generate_latest(self._registry)


class _Now(Collector):
    """What the slots do now, and the memory of their cards."""

    def __init__(self, slots: Sequence[SlotProcess], gpus: dict[str, str]) -> None:
        self._slots, self._gpus = slots, gpus

    def collect(self) -> Iterator[Metric]:
        slots = GaugeMetricFamily("refine_worker_slots", "Slots of this worker.", labels=["device", "state"])
        for device in sorted({slot.plan.device for slot in self._slots}):
            states = [slot.state for slot in self._slots if slot.plan.device == device]
            for state in [*map(str, SlotState), STOPPED]:
                slots.add_metric([device, state], states.count(state))
        yield slots
        used = GaugeMetricFamily(
            "refine_worker_gpu_memory_used_bytes", "Used memory of the card.", labels=["device"]
        )
        size = GaugeMetricFamily(
            "refine_worker_gpu_memory_size_bytes", "Memory of the card.", labels=["device"]
        )
        for device, uuid in sorted(self._gpus.items()):
            if memory := gpu_memory(uuid):
                used.add_metric([device], memory.used_bytes)
                size.add_metric([device], memory.size_bytes)
        yield used
        yield size
