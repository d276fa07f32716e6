"""Starts the slots, restarts one that ends or hangs, runs the reaper, and stops them all."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Sequence
from multiprocessing.connection import wait
from types import FrameType
from urllib.parse import urlsplit

from redis.exceptions import RedisError

from refine_jobs import reaper
from refine_jobs.blobs import BlobStore
from refine_jobs.logs import configure_logs
from refine_jobs.redis_server import check_server, connect
from refine_jobs.settings import JobSettings
from refine_jobs.slots import SlotState
from refine_jobs.worker_store import WorkerStore
from refine_proto.commands.cores import usable_cores
from refine_proto.commands.ending import FAILED

from .host_memory import usable_memory_bytes
from .metrics import WorkerMetrics
from .plan import PlanError, SlotPlan, find_cuda_devices, plan_slots
from .port import PROBES, Answer, Port
from .settings import WorkerSettings
from .slot_process import SlotProcess

_POLL_S = 0.2
_STOP_MARGIN_S = 10.0  # what a slot needs beyond its grace period to say goodbye
_COLD_STOP_S = 5.0
_LOOP_S = 30.0  # a supervisor that has not looked for so long hangs itself

log = logging.getLogger(__name__)


def build_supervisor() -> Supervisor:
    """By the settings. Raises ValidationError, PlanError, RedisUnfit, RedisError or OSError."""
    configure_logs()
    jobs, settings = JobSettings.from_environment(), WorkerSettings.from_environment()
    if jobs.redis_url is None:
        raise PlanError(
            "expected REFINE_REDIS_URL, the Redis of the service; `refine serve` runs everything with a "
            "Redis of its own"
        )
    url = jobs.redis_url.get_secret_value()
    server = connect(url)
    check_server(server, sync_submissions=False)  # the service, which promises that, has asked
    blobs = BlobStore(jobs.blob_location)
    blobs.check_writable()
    cores = usable_cores()
    cuda_devices = [] if settings.devices == "cpu" else find_cuda_devices()
    plans = plan_slots(
        settings, cores, usable_memory_bytes(), cuda_devices, f"{socket.gethostname()}-{os.getpid()}"
    )
    address = urlsplit(url)
    redis_name = address.hostname or address.path  # not the URL: it may hold a password
    print(f"refine worker: pool {jobs.pool}, Redis {redis_name}, blobs {jobs.blob_location}")
    for device in dict.fromkeys(plan.device for plan in plans):
        count = sum(plan.device == device for plan in plans)
        print(f"  {device}: slots: {count}, threads per slot: {plans[0].threads}, cores: {cores}", flush=True)
    return Supervisor(plans, WorkerStore(server, jobs), blobs, settings)


class Supervisor:
    """Runs until it gets SIGTERM or SIGINT; a second one stops without waiting for running jobs."""

    def __init__(
        self, plans: Sequence[SlotPlan], store: WorkerStore, blobs: BlobStore, settings: WorkerSettings
    ) -> None:
        self._plans, self._store, self._blobs, self._settings = plans, store, blobs, settings
        self._signals = 0
        self._slots: list[SlotProcess] = []
        self._metrics: WorkerMetrics
        self._looked = time.monotonic()
        probes = {PROBES["live"]: self._live, PROBES["ready"]: self._ready}
        self._port = (
            Port(settings.worker_host, settings.worker_port, probes, lambda: self._metrics.exposition())
            if settings.worker_port is not None
            else None
        )

    def run(self) -> int:
        """Serve until told to stop: 0, or 1 if not one slot could start at all."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        threading.Thread(target=self._reap_forever, name="reaper", daemon=True).start()
        self._slots = [SlotProcess(plan, self._settings.slot_timeout_s) for plan in self._plans]
        self._metrics = WorkerMetrics(self._slots)
        if self._port is not None:
            threading.Thread(target=self._port.serve, name="port", daemon=True).start()
        code = 0
        while not self._signals:
            self._look()
            if all(slot.failed_at_first for slot in self._slots):
                log.error("no slot could start its engine process; what it needs is missing or broken")
                code = FAILED
                self._signals += 1  # stop as if told to
        self._stop([slot.process for slot in self._slots])
        for plan in self._plans:
            try:
                self._store.hide(plan.name)
            except RedisError:
                break  # they disappear by themselves
        print("refine worker: stopped", flush=True)
        return code

    def _look(self) -> None:
        """Hear the slots, and see to those that are gone."""
        self._hear(_POLL_S)
        for slot in self._slots:
            if ending := slot.keep_alive():
                self._metrics.count_restart(slot.plan.device, ending)

    def _hear(self, patience_s: float) -> None:
        """Wait for reports, and count them."""
        self._looked = time.monotonic()
        connections = [slot.connection for slot in self._slots if not slot.connection.closed]
        ready = wait(connections, patience_s)
        for slot in self._slots:
            if slot.connection in ready:
                for report in slot.reports():
                    self._metrics.count(slot.plan.device, report)

    def _live(self) -> Answer:
        """That a slot hangs is mended here and no reason to end the others; that it is not mended is one."""
        silent_s = time.monotonic() - self._looked
        if silent_s > _LOOP_S:
            return Answer(False, f"not live: the supervisor has not looked at its slots for {silent_s:.0f} s")
        lost = [slot.plan.name for slot in self._slots if slot.silent_s > 2 * self._settings.slot_timeout_s]
        if lost and not self._signals:
            return Answer(False, f"not live: no report from {', '.join(lost)}")
        return Answer(True, "live")

    def _ready(self) -> Answer:
        if self._signals:
            return Answer(False, "not ready: stopping")
        able = sum(slot.state in (SlotState.IDLE, SlotState.BUSY) for slot in self._slots)
        line = f"{able} of {len(self._plans)} slots can work"
        return Answer(True, f"ready: {line}") if able else Answer(False, f"not ready: {line}")

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._signals += 1

    def _stop(self, processes: Sequence[subprocess.Popen[bytes]]) -> None:
        print("refine worker: stopping; running jobs may end; a second signal stops at once", flush=True)
        asked = 0
        while any(process.poll() is None for process in processes):
            if asked < min(self._signals, 2):
                asked += 1
                patience_s = self._settings.stop_grace_s + _STOP_MARGIN_S if asked == 1 else _COLD_STOP_S
                give_up_at = time.monotonic() + patience_s
                for process in processes:
                    process.send_signal(signal.SIGTERM)
            if time.monotonic() > give_up_at:
                for process in processes:
                    process.kill()
            self._hear(_POLL_S / 4)

    def _reap_forever(self) -> None:
        while True:
            try:
                reaper.reap(self._store, self._blobs)
            except Exception:  # whatever it was, the next round may succeed
                log.exception("the reaper failed")
            time.sleep(reaper.PERIOD_S)
