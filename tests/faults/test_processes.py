"""Slots and engine processes that hang or are killed: they are replaced, and no job is lost by it."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import psutil
import pytest
from PIL import Image
from worker_process import wait_until

from refine_jobs import keys
from refine_jobs.slots import SlotState
from refine_proto.models import State

if TYPE_CHECKING:
    from worker_process import StartWorker, Worker, Workplace

LONG = 10_000  # iterations; nobody waits for their end


@pytest.fixture
def worker(start_worker: StartWorker, workplace: Workplace) -> Iterator[Worker]:
    """Of one slot, which is replaced soon when it hangs."""
    with start_worker(workplace, slot_timeout_s="3") as worker:
        yield worker


def test_a_slot_that_hangs_is_replaced(worker: Worker, workplace: Workplace) -> None:
    job_id = workplace.submit(iterations=LONG)
    workplace.refining(job_id)
    hung = psutil.Process(worker.slot_pid())
    [engine] = hung.children()
    hung.suspend()
    wait_until(lambda: not hung.is_running(), "the end of the slot that hangs")
    workplace.taken_back(job_id, 1)
    assert workplace.refining(job_id, attempt=2).slot == worker.slots()[0].name
    assert worker.slot_pid() != hung.pid
    psutil.wait_procs([engine], timeout=20)
    assert not engine.is_running()


def test_a_slot_that_hangs_without_a_job_is_replaced(worker: Worker, workplace: Workplace) -> None:
    hung = psutil.Process(worker.slot_pid())
    hung.suspend()
    wait_until(lambda: not hung.is_running(), "the end of the slot that hangs")
    assert workplace.ended(workplace.submit(iterations=4)).state is State.SUCCEEDED


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a thread of the engine must be able to run")
def test_an_engine_that_can_run_nothing_ends_with_its_slot(worker: Worker, workplace: Workplace) -> None:
    """As one in a native call that holds the GIL."""
    workplace.refining(workplace.submit(iterations=LONG))
    slot = psutil.Process(worker.slot_pid())
    [engine] = slot.children()
    engine.suspend()
    slot.kill()
    psutil.wait_procs([engine], timeout=20)
    assert not engine.is_running()


def test_an_idle_engine_that_is_killed_is_replaced_before_the_next_job(
    worker: Worker, workplace: Workplace
) -> None:
    [before] = worker.engine_pids()
    wait_until(lambda: [slot.state for slot in worker.slots()] == [SlotState.IDLE], "an idle slot")
    os.kill(before, signal.SIGKILL)
    wait_until(lambda: len(worker.engine_pids()) == 2, "another engine process")
    job = workplace.ended(workplace.submit(iterations=4))
    assert (job.state, job.attempt) == (State.SUCCEEDED, 1)
    assert len(worker.engine_pids()) == 2


def test_a_job_whose_engine_is_killed_is_tried_again(worker: Worker, workplace: Workplace) -> None:
    slot = worker.slot_pid()
    job_id = workplace.submit(iterations=40)
    workplace.refining(job_id)
    os.kill(worker.engine_pids()[-1], signal.SIGKILL)
    job = workplace.ended(job_id)
    assert (job.state, job.attempt) == (State.SUCCEEDED, 2), job.error
    assert workplace.redis.hget(keys.JOB + job_id, "lost") == "1"
    assert worker.slot_pid() == slot


def test_a_job_that_kills_its_engine_every_time_fails_and_takes_nobody_with_it(
    worker: Worker, workplace: Workplace
) -> None:
    slot = worker.slot_pid()
    poison, other = workplace.submit(iterations=LONG), workplace.submit(iterations=4)
    for attempt in (1, 2):
        workplace.refining(poison, attempt)
        os.kill(worker.engine_pids()[-1], signal.SIGKILL)
        wait_until(lambda: workplace.job(poison).state is not State.RUNNING, "the end of the attempt")
    job = workplace.ended(poison)
    assert (job.state, job.attempt) == (State.FAILED, 2)
    assert job.error
    assert job.error.reason == "WORKER_LOST"
    assert "SIGKILL); that was the last of 2 attempts" in job.error.detail
    assert workplace.ended(other).state is State.SUCCEEDED
    assert worker.slot_pid() == slot


def test_a_cancelled_job_whose_engine_is_killed_is_cancelled(
    start_worker: StartWorker, workplace: Workplace
) -> None:
    with start_worker(workplace, cancel_grace_s="60") as worker:
        job_id = workplace.submit(iterations=LONG)
        workplace.refining(job_id)
        engine = psutil.Process(worker.engine_pids()[-1])
        engine.suspend()
        workplace.cancel(job_id)
        engine.kill()
        assert workplace.ended(job_id).state is State.CANCELLED


def test_files_that_are_never_read_cost_attempts_and_then_the_job(
    start_worker: StartWorker, workplace: Workplace
) -> None:
    """By the clock on the wall: the machine may have had no time for them."""
    image = io.BytesIO()
    Image.new("RGBA", (4096, 4096), "white").save(image, "PNG")  # few bytes that take a second
    with start_worker(workplace, read_timeout_s="0.001"):
        job = workplace.ended(workplace.submit(silhouette=image.getvalue(), iterations=4))
    assert (job.state, job.attempt) == (State.FAILED, 2)
    assert job.error
    assert job.error.reason == "MESH_INVALID"
