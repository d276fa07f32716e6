"""The slot's side of its engine process: start it, talk to it, kill it, and say why it died."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from refine_jobs.logs import fields
from refine_proto.errors import Internal, MeshInvalid, OutOfMemory, RefineError, WorkerLost

from .. import messages
from ..messages import Cancel, FromEngine, Ready, Run
from ..plan import SlotPlan
from ..reports import EngineEnd, EngineEnded, EngineStarted, Report
from ..settings import WorkerSettings

_SECRETS = ("REFINE_REDIS_URL",)  # what the process that parses strangers' files need not know
_CRASH_REPORT_BYTES = 2**16
_KILLED = (-signal.SIGKILL, -signal.SIGTERM)
_EXIT_S = 5.0  # from closing the pipe to killing

log = logging.getLogger(__name__)


class EngineStartFailed(Exception):
    """The engine process did not become ready; the message says why."""


class EngineDied(Exception):
    """The engine process is gone; `error` is what that means for its job.

    `killed`: from outside, so that it may go better another time.
    """

    def __init__(self, error: RefineError, killed: bool) -> None:
        super().__init__(error.detail)
        self.error, self.killed = error, killed


class EngineProcess:
    """A warm process that refines one job after the other. Used by one thread, `warm` apart."""

    def __init__(
        self,
        plan: SlotPlan,
        settings: WorkerSettings,
        blob_location: str,
        report: Callable[[Report], None],
    ) -> None:
        self._plan, self._settings, self._blob_location = plan, settings, blob_location
        self._report = report
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._crash_report = _anonymous_file()  # where faulthandler writes
        self._jobs = 0
        self._oom_kills = 0

    @property
    def warm(self) -> bool:
        """Whether the next job need not wait for a new process. Any thread may ask."""
        process = self._process
        alive = process is not None and process.poll() is None
        return alive and self._jobs < self._settings.jobs_per_engine

    def prepare(self) -> None:
        """Make sure that a warm process waits for a job. Raises EngineStartFailed."""
        if self._jobs >= self._settings.jobs_per_engine:
            log.info("the engine process has done %d jobs and is replaced", self._jobs)
            self._stop_idle()
        if self._process is not None and self._process.poll() is not None:
            log.warning("the engine process ended while idle: %s", _ending(self._process.returncode))
            self._forget(EngineEnd.DIED)
        if self._process is None:
            self._start()

    def run(self, run: Run) -> None:
        """Begin a job. Raises EngineDied."""
        self._jobs += 1
        self._oom_kills = _oom_kills()
        self._send(run)

    def cancel(self) -> None:
        """Ask to stop after the current iteration. Raises EngineDied."""
        self._send(Cancel())

    def receive(self, timeout_s: float) -> FromEngine | None:
        """The next message, or None if there is none in time. Raises EngineDied."""
        assert self._connection is not None
        try:
            return messages.receive_in_slot(self._connection) if self._connection.poll(timeout_s) else None
        except (EOFError, OSError):
            raise self._bury() from None

    def kill(self) -> None:
        """End the process at once, whatever it does. Safe to repeat."""
        if self._process is not None:
            self._end(self._process, EngineEnd.STOPPED)

    def _stop_idle(self) -> None:
        """End a process that has done its jobs."""
        assert self._connection is not None
        assert self._process is not None
        self._connection.close()  # it takes that as the end
        try:
            self._process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            log.warning("the engine process did not end by itself and is killed")
        self._end(self._process, EngineEnd.PLANNED)

    def _end(self, process: subprocess.Popen[bytes], cause: EngineEnd) -> None:
        process.kill()
        process.wait()
        self._forget(cause)

    def _start(self) -> None:
        ours, theirs = Pipe()
        command = [
            sys.executable, "-m", "refine_worker.engine", str(os.getpid()), str(theirs.fileno()),
            str(self._crash_report), self._plan.name, str(self._plan.threads), self._blob_location,
            self._plan.read_limits.model_dump_json(), str(self._settings.checkpoint_s),
        ]  # fmt: skip
        environment = {k: v for k, v in os.environ.items() if k not in _SECRETS}
        with theirs:
            self._process = subprocess.Popen(
                command,
                env=environment | self._plan.engine_environment(),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno(), self._crash_report],
            )
        self._connection, self._jobs = ours, 0
        try:
            ready = self.receive(self._settings.start_timeout_s)
        except EngineDied as died:
            raise EngineStartFailed(f"the engine process ended before it was ready: {died}") from None
        except BaseException:  # a signal asks this slot to stop
            self.kill()
            raise
        if not isinstance(ready, Ready):
            self.kill()
            raise EngineStartFailed(
                f"the engine process was not ready within {self._settings.start_timeout_s:g} s "
                "(REFINE_START_TIMEOUT_S)"
            )
        log.info("the engine is warm after %.1f s", ready.seconds, extra=fields(engine_pid=self._process.pid))
        self._report(EngineStarted(seconds=ready.seconds, gpu_uuid=ready.gpu_uuid))

    def _send(self, message: Run | Cancel) -> None:
        assert self._connection is not None
        try:
            messages.send(self._connection, message)
        except OSError:
            raise self._bury() from None

    def _bury(self) -> EngineDied:
        """Take leave of a process that has closed its pipe; what its end means for its job."""
        assert self._process is not None
        try:
            code = self._process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self._forget(EngineEnd.DIED)
        log.error(
            "the engine process died: %s", _ending(code), extra=fields(stacks=self._read_crash_report())
        )
        return EngineDied(
            _cause_of_death(code, out_of_memory=_oom_kills() > self._oom_kills), killed=code in _KILLED
        )

    def _read_crash_report(self) -> str:
        """What a fatal error left, and room for the next."""
        os.lseek(self._crash_report, 0, os.SEEK_SET)
        report = os.read(self._crash_report, _CRASH_REPORT_BYTES).decode(errors="replace")
        os.lseek(self._crash_report, 0, os.SEEK_SET)
        os.ftruncate(self._crash_report, 0)
        return report

    def _forget(self, cause: EngineEnd) -> None:
        self._report(EngineEnded(cause=cause))
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None


def _cause_of_death(code: int, out_of_memory: bool) -> RefineError:
    ending = _ending(code)
    if code == -signal.SIGKILL and out_of_memory:
        return OutOfMemory(
            f"the engine process was killed by the system for lack of memory ({ending}); "
            "use a mesh with fewer vertices, fewer slots or a larger machine"
        )
    if code == -signal.SIGXCPU:
        return MeshInvalid("expected files that can be read in less CPU time; simplify the mesh")
    if code in _KILLED:
        return WorkerLost(f"the engine process was killed from outside ({ending})")
    return Internal(f"the engine process crashed ({ending}); please report it with the request id")


def _ending(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _oom_kills() -> int:
    """How many processes Linux has killed so far for lack of memory; 0 where nothing tells."""
    try:
        counters = dict(line.split() for line in Path("/proc/vmstat").read_text().splitlines())
    except OSError:
        return 0
    return int(counters.get("oom_kill", 0))


def _anonymous_file() -> int:
    """Descriptor of a file without a name, open as long as this process lives."""
    descriptor, path = tempfile.mkstemp(prefix="refine-")
    os.unlink(path)
    return descriptor
