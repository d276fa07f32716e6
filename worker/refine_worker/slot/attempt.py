"""One attempt at a job, as the slot sees it: from the engine's first word to its last, under all limits."""

from __future__ import annotations

import logging
import time

from redis.exceptions import RedisError

from refine_jobs.logs import fields_of
from refine_jobs.record import Job
from refine_proto.errors import Cancelled, DeadlineExceeded, Internal, MeshInvalid, RefineError, error_class
from refine_proto.models import Progress, State
from refine_proto.tracing import Kind, Span, start_span

from ..messages import Answered, Done, Failed, FromEngine, Phase, PhaseStarted, Progressed, Returned, Run
from .engine_process import EngineDied
from .slot import Slot

_TICK_S = 0.5  # the lease is renewed, progress reported and a cancellation noticed so often

log = logging.getLogger(__name__)


class Stopped(Exception):
    """The slot cannot go on with the job, through no fault of the job."""


class Lost(Exception):
    """The engine process was killed or held up during the job, perhaps by the job; `error` says how."""

    def __init__(self, error: RefineError) -> None:
        super().__init__(error.detail)
        self.error = error


class Attempt:
    """Watches over the engine process while it works on `job`."""

    def __init__(self, slot: Slot, job: Job, traceparent: str | None) -> None:
        self._traceparent = traceparent
        self._stage_span: Span | None = None
        self._slot, self._job, self._settings = slot, job, slot.settings
        self._started = self._phase_started = self._last_sign = time.monotonic()
        self._read_wall_s = slot.plan.read_limits.wall_s(job.size_bytes)
        self._phase = Phase.FETCH
        self._progress: Progress | None = None  # not reported yet
        self._cancelled_at: float | None = None
        self._begun = False  # whether the engine has said anything of the job
        self.stages: dict[Phase, float] = {}  # seconds, of those that have ended

    def run(self) -> Done | Answered:
        """Wait for the result.

        Raises an error of refine_proto.errors for the job, Stopped, Lost, or LeaseLost. After all of them
        the engine process is idle or gone.
        """
        try:
            ended = self._run()
        except EngineDied as died:
            if not died.killed:
                raise died.error from None
            if self._begun:
                raise Lost(died.error) from None
            raise Stopped(f"{died.error.detail}, before it began") from None
        except BaseException:  # LeaseLost, a limit, a signal: it is still at work
            self._slot.engine.kill()
            raise
        finally:
            self._end_stage()
        if isinstance(ended, Returned):
            self._slot.blobs_failed = True
            raise Stopped(ended.why)
        if not isinstance(ended, Failed):
            return ended
        if ended.replace_engine:
            self._slot.engine.kill()
        raise error_class(ended.reason)(ended.detail)

    def _run(self) -> Done | Answered | Failed | Returned:
        engine, job = self._slot.engine, self._job
        run = Run(
            job_id=job.id,
            attempt=job.attempt,
            task=job.task,
            spec=job.spec,
            more_files=tuple(job.more_files),
            log_fields=fields_of(job),
        )
        engine.run(run)
        next_tick = self._started + _TICK_S
        while True:
            self._slot.give_sign()
            message = engine.receive(max(0.0, self._wake_at(next_tick) - time.monotonic()))
            if isinstance(message, Done | Answered | Failed | Returned):
                if self._progress:  # the last iteration; watchers wait for it
                    self._renew()
                return message
            if message is not None:
                self._note(message)
            if time.monotonic() >= next_tick:
                self._renew()
                next_tick = time.monotonic() + _TICK_S
            self._check_limits()

    def _wake_at(self, next_tick: float) -> float:
        """A cancellation is not left to the ticks: it has to act within 2 s."""
        if self._cancelled_at is None:
            return next_tick
        return min(next_tick, self._cancelled_at + self._settings.cancel_grace_s)

    def _note(self, message: FromEngine) -> None:
        self._begun, self._last_sign = True, time.monotonic()
        if isinstance(message, PhaseStarted):
            self._end_stage()
            self._phase, self._phase_started = message.phase, self._last_sign
            self._stage_span = start_span(message.phase, Kind.INTERNAL, self._traceparent)
        elif isinstance(message, Progressed):
            self._progress = message.progress

    def _end_stage(self) -> None:
        if self._begun:
            self.stages[self._phase] = time.monotonic() - self._phase_started
        if self._stage_span is not None:
            self._stage_span.end()
            self._stage_span = None

    def _renew(self) -> None:
        """Keep the job, tell its progress, and hear whether it shall stop."""
        store, job = self._slot.store, self._job
        try:
            state = store.report(job, self._progress) if self._progress else store.renew(job)
        except RedisError as error:
            log.warning("the lease could not be renewed, the job goes on: %s", error)
            return
        self._progress = None
        if state is State.CANCELLING and self._cancelled_at is None:
            self._cancelled_at = time.monotonic()
            self._slot.engine.cancel()

    def _check_limits(self) -> None:
        now, settings = time.monotonic(), self._settings
        if self._cancelled_at is not None and now - self._cancelled_at >= settings.cancel_grace_s:
            raise Cancelled("stopped as was asked for; the engine was in the middle of a step")
        if self._slot.stop_at is not None and now > self._slot.stop_at:
            raise Stopped("its worker was shut down")
        if now - self._started > self._job.timeout_s:
            raise DeadlineExceeded(
                f"expected an end within {self._job.timeout_s:g} s (options.timeout_s), got none in phase "
                f"{self._phase}; allow more time or ask for fewer iterations"
            )
        if self._phase is Phase.READ and now - self._phase_started > self._read_wall_s:
            # The engine process keeps to its CPU seconds: it was stopped, or the machine has no time for it.
            raise Lost(
                MeshInvalid(
                    f"expected files that can be read in {self._read_wall_s:.3g} s; simplify the mesh"
                )
            )
        if now - self._last_sign > settings.stall_timeout_s:
            raise Internal(
                f"the engine made no progress for {settings.stall_timeout_s:g} s in phase {self._phase} "
                "and was stopped; please report it with the request id"
            )
