"""A slot: its name, the job store, its engine process, and what it tells the others about itself."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from redis.exceptions import RedisError

from refine_jobs import keys
from refine_jobs.blobs import BlobStore, BlobStoreFailed
from refine_jobs.logs import fields_of, log_fields
from refine_jobs.record import Job
from refine_jobs.slots import SlotState, SlotStatus
from refine_jobs.worker_store import WorkerStore

from ..plan import SlotPlan
from ..reports import BEAT_S, Beat, Report
from ..settings import WorkerSettings
from .engine_process import EngineProcess

_PULSE_S = keys.SLOT_S / 3
_BLOBS_PAUSE_S = 5.0  # before the blob store is tried again
_HANGS_S = 60.0  # without a sign of the thread that does a job; longer than Redis may take to answer or not

log = logging.getLogger(__name__)


class Slot:
    """What one slot has: a name, the job store, an engine process."""

    def __init__(
        self,
        plan: SlotPlan,
        store: WorkerStore,
        engine: EngineProcess,
        blobs: BlobStore,
        settings: WorkerSettings,
        report: Callable[[Report], None],
    ) -> None:
        self.plan, self.store, self.engine, self.settings = plan, store, engine, settings
        self._blobs = blobs
        self.blobs_failed = False  # in the last job: no other one before they work
        self.report = report
        self.stop_at: float | None = None  # monotonic time by which a running job is given back
        self._state = SlotState.STARTING
        self._job_id: str | None = None
        self._last_sign = time.monotonic()
        self._telling = threading.Lock()  # what is told last is true
        self._closed = False
        self._pulse_now = threading.Event()
        threading.Thread(target=self._pulse, name="pulse", daemon=True).start()
        threading.Thread(target=self._beat, name="beat", daemon=True).start()

    @property
    def name(self) -> str:
        """The slot's name in records, logs and metrics."""
        return self.plan.name

    def prepare(self) -> None:
        """Have a warm engine process. Raises EngineStartFailed."""
        if not self.engine.warm:
            self._rest()
            self.engine.prepare()
            self._rest()

    def wait_for_blobs(self) -> None:
        """If the blob store has failed, return once it takes writes: jobs wait in the queue until then."""
        while self.blobs_failed:
            self.show(SlotState.STARTING)
            time.sleep(_BLOBS_PAUSE_S)
            try:
                self._blobs.check_writable()
            except BlobStoreFailed as error:
                log.warning("no job is taken: %s", error)
            else:
                self.blobs_failed = False
                self._rest()

    @contextmanager
    def busy_with(self, job: Job) -> Iterator[None]:
        """Inside, the slot is shown as busy and the lines of the log carry the job's ids."""
        self.give_sign()
        self.show(SlotState.BUSY, job.id)
        with log_fields(fields_of(job)):
            try:
                yield
            finally:
                self._rest()

    def give_sign(self) -> None:
        """The thread that does a job has not hung; it says so at least every few seconds."""
        self._last_sign = time.monotonic()

    def drain(self) -> None:
        """Take no other job; give the running one back after the grace period."""
        self.stop_at = time.monotonic() + self.settings.stop_grace_s
        self._pulse_now.set()  # a signal handler calls this: no word to Redis from here

    def close(self) -> None:
        """End the engine process and disappear."""
        self.engine.kill()
        with self._telling:
            self._closed = True
            try:
                self.store.hide(self.name)
            except RedisError as error:
                log.warning("the slot could not sign off: %s", error)
        self._pulse_now.set()

    def show(self, state: SlotState, job_id: str | None = None) -> None:
        """Tell the others what this slot does."""
        with self._telling:
            self._state, self._job_id = state, job_id
            self._tell()

    def _rest(self) -> None:
        self.show(SlotState.IDLE if self.engine.warm else SlotState.STARTING)

    def _pulse(self) -> None:
        while not self._closed:
            with self._telling:
                self._tell()
            self._pulse_now.wait(_PULSE_S)
            self._pulse_now.clear()

    def _beat(self) -> None:
        """Report to the supervisor, whatever Redis does, unless a job hangs in this process."""
        while not self._closed:
            if self._state is not SlotState.BUSY or time.monotonic() - self._last_sign < _HANGS_S:
                self.report(Beat(state=self._shown_state()))
            time.sleep(BEAT_S)

    def _shown_state(self) -> SlotState:
        if self.stop_at is not None:
            return SlotState.DRAINING
        if self._state is SlotState.IDLE and not self.engine.warm:  # it died while idle
            return SlotState.STARTING
        return self._state

    def _tell(self) -> None:
        """Both threads do; the caller holds the lock."""
        if self._closed:
            return
        status = SlotStatus(
            name=self.name, device=self.plan.device, state=self._shown_state(), job_id=self._job_id
        )
        try:
            self.store.show(status)
        except RedisError as error:
            log.warning("the slot could not show itself: %s", error)


SLOT: ContextVar[Slot] = ContextVar("the slot of this process")
