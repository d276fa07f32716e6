"""The task: what a slot does with one job.

    claim -> the engine process reads the blobs, refines, writes the artifacts -> finish or fail

The record in the job store is the truth; RQ only brings the id. Every end of the engine process, good or bad,
becomes an end of the job here, and the slot lives on.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from functools import partial

from redis.exceptions import RedisError

from refine_jobs.logs import fields
from refine_jobs.record import Job
from refine_jobs.spans import process_span
from refine_jobs.worker_store import LeaseLost
from refine_proto.errors import Cancelled, Internal, RefineError

from ..messages import Answered
from ..reports import AttemptEnded, Outcome
from .attempt import Attempt, Lost, Stopped
from .slot import SLOT, Slot

_WRITE_FOR_S = 60.0  # how long a slot tries to write the end of a job while Redis is away
_WRITE_PAUSE_S = 1.0

log = logging.getLogger(__name__)


def run(job_id: str) -> None:
    """Refine one job in this process's slot. What goes wrong with the job is written into its record."""
    slot = SLOT.get()
    job = slot.store.claim(job_id, slot.name)
    if job is None:
        log.info("job %s is not queued any more", job_id)
        return
    with slot.busy_with(job), process_span(slot.store.queue, job) as span:
        started = time.monotonic()
        log.info("started")
        attempt = Attempt(slot, job, span.traceparent)
        try:
            outcome, write = _work(slot, job, attempt)
            _persist(slot, write)
        except LeaseLost as error:
            log.warning("%s; its result is dropped", error)
            outcome = Outcome.LOST
        span.set({"refine.outcome": outcome})
        if outcome in (Outcome.FAILED, Outcome.LOST):
            span.fail(outcome)
        slot.report(
            AttemptEnded(outcome=outcome, preset=job.spec["options"]["preset"], stages=attempt.stages)
        )
        log.info("ended", extra=fields(run_s=round(time.monotonic() - started, 3)))


def _work(slot: Slot, job: Job, attempt: Attempt) -> tuple[Outcome, Callable[[], object]]:
    """Do the job; how it ended, and how that is to be written. Raises LeaseLost."""
    failure: RefineError
    try:
        done = attempt.run()
        if isinstance(done, Answered):
            return Outcome.SUCCEEDED, partial(slot.store.answer, job, done.answer)
        return Outcome.SUCCEEDED, partial(slot.store.finish, job, done.artifacts, done.judgement, done.checks)
    except LeaseLost:
        raise
    except Cancelled:
        return Outcome.CANCELLED, partial(slot.store.cancelled, job)
    except (Stopped, SystemExit) as stop:
        log.warning("given back: %s", stop)
        return Outcome.RETURNED, partial(slot.store.give_back, job, str(stop))
    except Lost as lost:
        log.warning("lost: %s", lost)
        return Outcome.LOST, partial(slot.store.lose, job, lost.error)
    except RefineError as error:
        failure = error
    except Exception as error:
        log.exception("the slot failed")
        failure = Internal(f"the worker failed ({type(error).__name__}); please report the request id")
    log.warning("failed: %s: %s", failure.reason, failure.detail)
    return Outcome.FAILED, partial(slot.store.fail, job, failure)


def _persist(slot: Slot, write: Callable[[], object]) -> None:
    """Write, also when Redis is away for a while. The fence of the lease makes a second try harmless."""
    give_up_at = time.monotonic() + _WRITE_FOR_S
    while True:
        slot.give_sign()
        try:
            write()
            return
        except RedisError as error:
            if time.monotonic() > give_up_at:
                raise
            log.warning("the end of the job is not written yet: %s", error)
            time.sleep(_WRITE_PAUSE_S)
