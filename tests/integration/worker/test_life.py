"""Slots and supervisors that end, as asked or not: jobs go on, and nothing is left over."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import psutil

from refine_jobs.slots import SlotState
from refine_proto.models import State

if TYPE_CHECKING:
    from worker_process import StartWorker, Worker, Workplace

LONG = 10_000  # iterations; nobody waits for their end


def kill_slot(worker: Worker) -> None:
    """As the kernel would; its engine process must end with it."""
    slot = psutil.Process(worker.slot_pid())
    engines = slot.children()
    slot.kill()
    _, alive = psutil.wait_procs(engines, timeout=20)
    assert engines
    assert not alive


def test_the_job_of_a_lost_slot_is_done_by_its_successor(worker: Worker, workplace: Workplace) -> None:
    job_id = workplace.submit(iterations=40)
    workplace.refining(job_id)
    kill_slot(worker)
    workplace.taken_back(job_id, 1)
    job = workplace.ended(job_id)
    assert (job.state, job.attempt) == (State.SUCCEEDED, 2), job.error


def test_a_job_that_loses_every_slot_fails(worker: Worker, workplace: Workplace) -> None:
    job_id = workplace.submit(iterations=LONG)
    for attempt in (1, 2):
        workplace.refining(job_id, attempt)
        kill_slot(worker)
        workplace.taken_back(job_id, attempt)
    job = workplace.job(job_id)
    assert (job.state, job.error and job.error.reason) == (State.FAILED, "WORKER_LOST")
    assert job.error
    assert "attempt 2; that was the last of 2" in job.error.detail


def test_sigterm_lets_a_job_end(start_worker: StartWorker, own_workplace: Workplace) -> None:
    """In a worker that replaces its engine process after every job."""
    with start_worker(own_workplace, jobs_per_engine="1") as worker:
        assert own_workplace.ended(own_workplace.submit(iterations=4)).state is State.SUCCEEDED
        job_id = own_workplace.submit(iterations=20)
        own_workplace.refining(job_id)
        assert worker.stop() == 0
        assert own_workplace.job(job_id).state is State.SUCCEEDED
        assert worker.slots() == []
        assert len(set(worker.engine_pids())) == 2
        assert "stopped" in worker.output


def test_sigterm_gives_a_long_job_back(start_worker: StartWorker, own_workplace: Workplace) -> None:
    with start_worker(own_workplace, stop_grace_s="3") as worker:
        job_id = own_workplace.submit(iterations=LONG)
        own_workplace.refining(job_id)
        worker.process.terminate()
        own_workplace.wait_until(
            lambda: [slot.state for slot in worker.slots()] == [SlotState.DRAINING], "a draining slot"
        )
        assert worker.process.wait(60) == 0
        job = own_workplace.job(job_id)
        assert (job.state, job.attempt, job.slot) == (State.QUEUED, 1, None)


def test_a_second_sigterm_stops_at_once(start_worker: StartWorker, own_workplace: Workplace) -> None:
    with start_worker(own_workplace, stop_grace_s="3600") as worker:
        job_id = own_workplace.submit(iterations=LONG)
        own_workplace.refining(job_id)
        worker.process.terminate()
        own_workplace.wait_until(lambda: "stopping" in worker.output, "the first signal")
        assert worker.stop() == 0
        assert own_workplace.job(job_id).state is State.QUEUED


def test_nothing_outlives_a_killed_supervisor(start_worker: StartWorker, own_workplace: Workplace) -> None:
    with start_worker(own_workplace, stop_grace_s="0") as worker:
        own_workplace.refining(own_workplace.submit(iterations=LONG))
        others = worker.tree()[1:]
        worker.process.kill()
        worker.process.wait()
        _, alive = psutil.wait_procs(others, timeout=30)
        assert len(others) == 2  # a slot and its engine process
        assert not alive


def test_settings_that_cannot_be_met_are_refused(own_workplace: Workplace) -> None:
    def start(**changes: str | None) -> tuple[int, str]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("REFINE_")}
        environment |= {k: v for k, v in (own_workplace.environment | changes).items() if v is not None}
        done = subprocess.run(
            [sys.executable, "-m", "refine_worker"], env=environment, capture_output=True, text=True
        )
        return done.returncode, done.stderr

    refused: list[tuple[dict[str, str | None], str]] = [
        ({"REFINE_REDIS_URL": None}, "expected REFINE_REDIS_URL"),
        ({"REFINE_DEVICES": "cpu", "REFINE_THREADS_PER_SLOT": "4096"}, "slots x threads"),
        ({"REFINE_DEVICES": "tpu"}, "expected REFINE_DEVICES to be auto, cpu, cuda"),
        ({"REFINE_STOP_GRACE_S": "soon"}, "stop_grace_s"),
    ]
    for changes, complaint in refused:
        code, errors = start(**changes)
        assert (code, errors.count("Traceback")) == (2, 0), errors
        assert complaint in errors


def test_a_slot_is_light() -> None:
    code = (
        "import sys, refine_worker.supervisor, refine_worker.slot.main, refine_worker.slot.task; "
        "print(sorted({'torch', 'numpy', 'numba', 'refine_engine'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
