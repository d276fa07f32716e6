"""`refine worker`: starts the slots, restarts one that ends, runs the reaper, and stops them all."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from types import FrameType
from urllib.parse import urlsplit

from pydantic import ValidationError
from redis.exceptions import RedisError

from refine_jobs import reaper
from refine_jobs.blobs import BlobStore
from refine_jobs.logs import configure_logs
from refine_jobs.redis_server import RedisUnfit, check_server, connect
from refine_jobs.settings import JobSettings
from refine_jobs.worker_store import WorkerStore
from refine_proto.commands.cores import usable_cores
from refine_proto.commands.ending import BAD_INPUT, FAILED

from .lifeline import stop_with_parent
from .plan import NEVER_READY, PlanError, SlotPlan, find_cuda_devices, plan_slots
from .settings import WorkerSettings

_POLL_S = 0.2
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0  # before a slot that ended is started again
_STABLE_S = 60.0  # a slot that lived so long starts again with the first pause
_STOP_MARGIN_S = 10.0  # what a slot needs beyond its grace period to say goodbye
_COLD_STOP_S = 5.0

log = logging.getLogger(__name__)


def worker_parser() -> argparse.ArgumentParser:
    """The arguments of `refine worker`."""
    parser = argparse.ArgumentParser(
        prog="refine worker",
        description="Run worker slots: they take jobs from the queue and refine them.",
        epilog="Settings are variables (REFINE_REDIS_URL, REFINE_DEVICES, ...): refine docs worker",
    )
    parser.add_argument(
        "--stop-with-stdin", action="store_true", help="stop when standard input closes, as if by SIGTERM"
    )
    return parser


def worker_command(argv: Sequence[str]) -> int:
    """0 stopped as asked, 1 no slot can start, 2 the settings cannot be used."""
    options = worker_parser().parse_args(argv)
    try:
        supervisor = _build()
    except (ValidationError, PlanError, RedisUnfit, RedisError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    if options.stop_with_stdin:
        stop_with_parent()
    return supervisor.run()


def _build() -> Supervisor:
    configure_logs()
    jobs, settings = JobSettings.from_environment(), WorkerSettings.from_environment()
    if jobs.redis_url is None:
        raise PlanError(
            "expected REFINE_REDIS_URL, the Redis of the service; `refine serve` runs everything with a "
            "Redis of its own"
        )
    url = jobs.redis_url.get_secret_value()
    server = connect(url)
    check_server(server)
    blobs = BlobStore(jobs.blob_location)
    blobs.check_writable()
    cores = usable_cores()
    cuda_devices = [] if settings.devices == "cpu" else find_cuda_devices()
    plans = plan_slots(settings, cores, cuda_devices, f"{socket.gethostname()}-{os.getpid()}")
    address = urlsplit(url)
    redis_name = address.hostname or address.path  # not the URL: it may hold a password
    print(f"refine worker: pool {jobs.pool}, Redis {redis_name}, blobs {jobs.blob_location}")
    for device in dict.fromkeys(plan.device for plan in plans):
        count = sum(plan.device == device for plan in plans)
        print(f"  {device}: slots: {count}, threads per slot: {plans[0].threads}, cores: {cores}", flush=True)
    return Supervisor(plans, WorkerStore(server, jobs), blobs, settings.stop_grace_s)


class _SlotProcess:
    """One slot's process, started again when it ends."""

    def __init__(self, plan: SlotPlan) -> None:
        self.plan = plan
        self._pause_s = _FIRST_PAUSE_S
        self._starts = 0
        self.failed_at_first = False
        self._start()

    def _start(self) -> None:
        # Its own session: Ctrl-C reaches the supervisor, which stops the slots. The pipe: see lifeline.py.
        self.process = subprocess.Popen(
            [sys.executable, "-m", "refine_worker.slot.main", self.plan.model_dump_json()],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        self._starts += 1
        self._started = time.monotonic()
        self._restart_at: float | None = None

    def keep_alive(self) -> None:
        code, now = self.process.poll(), time.monotonic()
        if code is None:
            return
        if self._restart_at is None:
            self.failed_at_first |= code == NEVER_READY and self._starts == 1
            self._pause_s = _FIRST_PAUSE_S if now - self._started > _STABLE_S else self._pause_s * 2
            self._pause_s = min(self._pause_s, _LONGEST_PAUSE_S)
            self._restart_at = now + self._pause_s
            log.warning("slot %s ended (%d) and starts again in %g s", self.plan.name, code, self._pause_s)
        elif now >= self._restart_at:
            self._start()


class Supervisor:
    """Runs until it gets SIGTERM or SIGINT; a second one stops without waiting for running jobs."""

    def __init__(
        self, plans: Sequence[SlotPlan], store: WorkerStore, blobs: BlobStore, stop_grace_s: float
    ) -> None:
        self._plans, self._store, self._blobs, self._stop_grace_s = plans, store, blobs, stop_grace_s
        self._signals = 0

    def run(self) -> int:
        """Serve until told to stop: 0, or 1 if not one slot could start at all."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        threading.Thread(target=self._reap_forever, name="reaper", daemon=True).start()
        slots = [_SlotProcess(plan) for plan in self._plans]
        code = 0
        while not self._signals:
            for slot in slots:
                slot.keep_alive()
            if all(slot.failed_at_first for slot in slots):
                log.error("no slot could start its engine process; what it needs is missing or broken")
                code = FAILED
                self._signals += 1  # stop as if told to
            time.sleep(_POLL_S)
        self._stop([slot.process for slot in slots])
        for plan in self._plans:
            try:
                self._store.hide(plan.name)
            except RedisError:
                break  # they disappear by themselves
        print("refine worker: stopped", flush=True)
        return code

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signals += 1

    def _stop(self, processes: Sequence[subprocess.Popen[bytes]]) -> None:
        print("refine worker: stopping; running jobs may end; a second signal stops at once", flush=True)
        asked = 0
        while any(process.poll() is None for process in processes):
            if asked < min(self._signals, 2):
                asked += 1
                patience_s = self._stop_grace_s + _STOP_MARGIN_S if asked == 1 else _COLD_STOP_S
                give_up_at = time.monotonic() + patience_s
                for process in processes:
                    process.send_signal(signal.SIGTERM)
            if time.monotonic() > give_up_at:
                for process in processes:
                    process.kill()
            time.sleep(_POLL_S / 4)

    def _reap_forever(self) -> None:
        while True:
            try:
                reaper.reap(self._store, self._blobs)
            except Exception:  # whatever it was, the next round may succeed
                log.exception("the reaper failed")
            time.sleep(reaper.PERIOD_S)
