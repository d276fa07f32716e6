"""A slot's process as the supervisor sees it: started, listened to, started again when it ends or hangs."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from enum import StrEnum
from multiprocessing import Pipe

from refine_jobs.slots import SlotState

from .plan import NEVER_READY, SlotPlan
from .reports import Beat, Report, receive

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0  # before a slot that ended is started again
_STABLE_S = 60.0  # a slot that lived so long starts again with the first pause
_LOADING_S = 60.0  # until the first report: on a busy machine the imports take long
STOPPED = "stopped"  # the state of a slot without a process

log = logging.getLogger(__name__)


class Ending(StrEnum):
    """Why a slot's process is started again."""

    ENDED = "ended"
    HUNG = "hung"


class SlotProcess:
    """One slot. Used by one thread; others may read `state` and `silent_s`."""

    def __init__(self, plan: SlotPlan, timeout_s: float) -> None:
        self.plan, self._timeout_s = plan, timeout_s
        self._pause_s = _FIRST_PAUSE_S
        self._starts = 0
        self.failed_at_first = False
        self._start()

    @property
    def silent_s(self) -> float:
        """Since its last report, or since it should have started to report; 0 without a process."""
        return 0.0 if self.state == STOPPED else time.monotonic() - self._heard

    def _start(self) -> None:
        self.connection, theirs = Pipe(duplex=False)
        descriptor = theirs.fileno()
        # Its own session: Ctrl-C reaches the supervisor, which stops the slots. stdin: see lifeline.py.
        with theirs:
            self.process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "refine_worker.slot.main",
                    self.plan.model_dump_json(),
                    str(descriptor),
                ],
                stdin=subprocess.PIPE,
                pass_fds=[descriptor],
                start_new_session=True,
            )
        self.state: str = SlotState.STARTING
        self._starts += 1
        self._started = time.monotonic()
        self._heard = self._started + _LOADING_S
        self._restart_at: float | None = None

    def reports(self) -> Iterator[Report]:
        """Those that have come."""
        try:
            while self.connection.poll():
                report = receive(self.connection)
                self._heard = time.monotonic()
                if isinstance(report, Beat):
                    self.state = report.state
                yield report
        except (EOFError, OSError):
            return

    def keep_alive(self) -> Ending | None:
        """Kill it if it hangs, start it again once it has ended; why, at the moment at which it has."""
        code, now = self.process.poll(), time.monotonic()
        ending = Ending.ENDED
        if code is None:
            if now - self._heard < self._timeout_s:
                return None
            log.error("slot %s has not reported for %g s and is killed", self.plan.name, self._timeout_s)
            self.process.kill()  # its engine process ends with it
            code, ending = self.process.wait(), Ending.HUNG
        if self._restart_at is None:
            self._rest(code, now)
            return ending
        if now >= self._restart_at:
            self._start()
        return None

    def _rest(self, code: int, now: float) -> None:
        self.connection.close()
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.state = STOPPED
        self.failed_at_first |= code == NEVER_READY and self._starts == 1
        self._pause_s = _FIRST_PAUSE_S if now - self._started > _STABLE_S else self._pause_s * 2
        self._pause_s = min(self._pause_s, _LONGEST_PAUSE_S)
        self._restart_at = now + self._pause_s
        log.warning("slot %s ended (%d) and starts again in %g s", self.plan.name, code, self._pause_s)
