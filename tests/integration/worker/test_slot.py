"""What a slot tells of itself, from two threads, on a real Redis."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from refine_jobs.slots import SlotState, SlotStatus
from refine_jobs.worker_store import WorkerStore
from refine_worker.plan import SlotPlan
from refine_worker.reports import BEAT_S, Beat, Report
from refine_worker.settings import ReadLimits, WorkerSettings
from refine_worker.slot import slot as slot_module
from refine_worker.slot.engine_process import EngineProcess
from refine_worker.slot.slot import Slot

if TYPE_CHECKING:
    from worker_process import Workplace

LIMITS = ReadLimits(base_cpu_s=8, base_wall_s=30, memory_bytes=2**30)
PLAN = SlotPlan(name="slot-7", device="cpu", threads=1, read_limits=LIMITS)


class SlowPulse(WorkerStore):
    """The job store, on which every word of the pulse waits until the test lets it go on."""

    def __init__(self, workplace: Workplace) -> None:
        super().__init__(workplace.redis, workplace.settings)
        self.speaking, self.go_on, self.spoken = threading.Event(), threading.Event(), threading.Event()

    def show(self, slot: SlotStatus) -> None:
        if threading.current_thread().name != "pulse":
            super().show(slot)
            return
        self.speaking.set()
        assert self.go_on.wait(20)
        super().show(slot)
        self.spoken.set()


@pytest.fixture
def store(own_workplace: Workplace) -> SlowPulse:
    return SlowPulse(own_workplace)


@pytest.fixture
def slot(store: SlowPulse, own_workplace: Workplace) -> Iterator[Slot]:
    settings = WorkerSettings()
    reports: list[Report] = []
    engine = EngineProcess(PLAN, settings, own_workplace.settings.blob_location, reports.append)
    slot = Slot(PLAN, store, engine, own_workplace.blobs, settings, reports.append)
    yield slot
    store.go_on.set()
    slot.close()


def shown(workplace: Workplace) -> list[tuple[SlotState, str | None]]:
    return [(found.state, found.job_id) for found in workplace.slots() if found.name == PLAN.name]


def test_a_late_word_of_the_pulse_does_not_undo_a_newer_one(
    slot: Slot, store: SlowPulse, own_workplace: Workplace
) -> None:
    assert store.speaking.wait(20)  # it is about to say that the slot is starting
    newer = threading.Thread(target=slot.show, args=(SlotState.BUSY, "job-1"))
    newer.start()
    newer.join(0.2)  # it may have to wait for the pulse
    store.go_on.set()
    newer.join(20)
    assert store.spoken.wait(20)
    assert shown(own_workplace) == [(SlotState.BUSY, "job-1")]


def test_a_slot_that_has_signed_off_stays_away(
    slot: Slot, store: SlowPulse, own_workplace: Workplace
) -> None:
    assert store.speaking.wait(20)
    closing = threading.Thread(target=slot.close)
    closing.start()
    closing.join(0.2)
    store.go_on.set()
    closing.join(20)
    assert store.spoken.wait(20)
    assert shown(own_workplace) == []


def test_a_slot_that_drains_says_so_whatever_it_does(
    slot: Slot, store: SlowPulse, own_workplace: Workplace
) -> None:
    store.go_on.set()
    slot.drain()
    slot.show(SlotState.BUSY, "job-1")
    assert shown(own_workplace) == [(SlotState.DRAINING, "job-1")]


def test_a_slot_whose_job_hangs_does_not_report(
    slot: Slot, store: SlowPulse, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that does the job gives no sign: the supervisor will kill the slot."""
    store.go_on.set()
    monkeypatch.setattr(slot_module, "_HANGS_S", 0.0)
    slot.show(SlotState.BUSY, "job-1")
    heard: list[Report] = []
    monkeypatch.setattr(slot, "report", heard.append)
    time.sleep(2.5 * BEAT_S)
    assert heard == []
    slot.show(SlotState.STARTING)
    time.sleep(2.5 * BEAT_S)
    assert Beat(state=SlotState.STARTING) in heard
