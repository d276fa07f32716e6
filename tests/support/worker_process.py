"""Real workers: `python -m refine_worker` on a real Redis, with jobs made from the sample files."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import psutil

from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_jobs.edge_store import JobStore
from refine_jobs.health import Health
from refine_jobs.reaper import reap
from refine_jobs.record import Job, Submission, Task
from refine_jobs.redis_server import connect, connect_async
from refine_jobs.settings import JobSettings
from refine_jobs.slots import SlotStatus
from refine_jobs.worker_store import WorkerStore
from refine_proto.models import RefinementSpec, State

SAMPLE = Path(__file__).parents[2] / "examples" / "samples" / "chair"
COARSE = (SAMPLE / "coarse.obj").read_bytes()
SILHOUETTE = (SAMPLE / "silhouette.png").read_bytes()
_PATIENCE_S = 120.0  # a machine that compiles kernels and runs other tests


def wait_until(holds: Callable[[], Any], what: str, patience_s: float = _PATIENCE_S) -> Any:
    """The first true value of `holds`."""
    give_up_at = time.monotonic() + patience_s
    while time.monotonic() < give_up_at:
        if value := holds():
            return value
        time.sleep(0.05)
    raise AssertionError(f"waited {patience_s:g} s in vain: {what}")


class Workplace:
    """A Redis, a blob folder, and what tests do at the edge."""

    REQUEST_ID = "req-7"
    TRACE_ID = "0af7651916cd43dd8448eb211c80319c"

    def __init__(self, redis_url: str, folder: Path, pool: str = "default") -> None:
        self.environment = {
            "REFINE_REDIS_URL": redis_url,
            "REFINE_DATA_FOLDER": str(folder),
            "REFINE_POOL": pool,
            "REFINE_LEASE_S": "4",
            "REFINE_MAX_ATTEMPTS": "2",
        }
        self.settings = JobSettings.from_environment(self.environment)
        self.redis: Any = connect(redis_url)  # its types cannot say that it decodes responses
        self.store = WorkerStore(self.redis, self.settings)
        self.blobs = BlobStore(self.settings.blob_location)

    def submit(
        self,
        mesh: bytes | None = None,
        task: Task = Task.REFINE,
        silhouette: bytes | None = None,
        **options: Any,
    ) -> str:
        """Queue the sample chair, or with another OBJ or PNG; the id."""
        spec = RefinementSpec.model_validate(
            {
                "camera": json.loads((SAMPLE / "camera.json").read_text()),
                "options": options,
                "mesh_format": "obj",
            }
        )

        async def post() -> str:
            store = JobStore(connect_async(self.environment["REFINE_REDIS_URL"]), self.settings)
            try:
                job_id = await store.begin_upload("ann")
                submission = Submission(
                    id=job_id,
                    owner="ann",
                    spec=spec,
                    task=task,
                    mesh=self.blobs.put(keys.input_blob(job_id, keys.MESH), mesh or COARSE),
                    silhouette=self.blobs.put(
                        keys.input_blob(job_id, keys.SILHOUETTE), silhouette or SILHOUETTE
                    ),
                    request_id=self.REQUEST_ID,
                    traceparent=f"00-{self.TRACE_ID}-b7ad6b7169203331-01",
                )
                return (await store.submit(submission)).refinement.id
            finally:
                await store.close()

        return asyncio.run(post())

    def cancel(self, job_id: str) -> None:
        async def post() -> None:
            store = JobStore(connect_async(self.environment["REFINE_REDIS_URL"]), self.settings)
            try:
                await store.cancel("ann", job_id)
            finally:
                await store.close()

        asyncio.run(post())

    wait_until = staticmethod(wait_until)

    def job(self, job_id: str) -> Job:
        return Job.decode(self.redis.hgetall(keys.JOB + job_id))

    def ended(self, job_id: str) -> Job:
        """The job, once it has ended."""
        wait_until(lambda: self.job(job_id).state.terminal, f"the end of {self.job(job_id)}")
        return self.job(job_id)

    def refining(self, job_id: str, attempt: int = 1) -> Job:
        """The job, once an attempt has reported progress."""

        def found() -> bool:
            job = self.job(job_id)
            assert not job.state.terminal, job
            return job.attempt == attempt and job.progress is not None

        wait_until(found, "progress")
        return self.job(job_id)

    def taken_back(self, job_id: str, attempt: int) -> Job:
        """The job, once the reaper has taken it from the slot that had it."""

        def taken() -> bool:
            reap(self.store, self.blobs)
            job = self.job(job_id)
            return (job.attempt, job.state) != (attempt, State.RUNNING)

        wait_until(taken, "the end of a lease")
        return self.job(job_id)

    def slots(self) -> list[SlotStatus]:
        """All slots that are alive, of every worker."""

        async def read() -> tuple[SlotStatus, ...]:
            async with connect_async(self.environment["REFINE_REDIS_URL"]) as redis:
                return await Health(redis).slots()

        return list(asyncio.run(read()))


class Worker:
    """A running `python -m refine_worker` and what it has logged."""

    def __init__(
        self, workplace: Workplace, process: subprocess.Popen[bytes], output: Path, logs: Path
    ) -> None:
        self.workplace, self.process, self._output, self._logs = workplace, process, output, logs

    @property
    def output(self) -> str:
        return self._output.read_text()

    @property
    def logs(self) -> list[dict[str, Any]]:
        """The complete lines; all are JSON."""
        lines = self._logs.read_text().rpartition("\n")[0].splitlines()
        return [json.loads(line) for line in lines]

    def engine_pids(self) -> list[int]:
        """Of all engine processes that became ready, in that order."""
        return [line["engine_pid"] for line in self.logs if "engine_pid" in line]

    def slot_pid(self) -> int:
        """Of the only slot."""
        [slot] = psutil.Process(self.process.pid).children()
        return slot.pid

    def slots(self) -> list[SlotStatus]:
        return [slot for slot in self.workplace.slots() if f"-{self.process.pid}-" in slot.name]

    def tree(self) -> list[psutil.Process]:
        supervisor = psutil.Process(self.process.pid)
        return [supervisor, *supervisor.children(recursive=True)]

    def wait_until_ready(self, slots: int = 1) -> None:
        def ready() -> bool:
            assert self.process.poll() is None, f"the worker ended:\n{self._logs.read_text()[-2000:]}"
            return self.output.count(": ready on ") >= slots

        wait_until(ready, f"{slots} warm slots")

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(_PATIENCE_S)


StartWorker = Callable[..., AbstractContextManager[Worker]]


@contextmanager
def run_worker(workplace: Workplace, folder: Path, **settings: str) -> Iterator[Worker]:
    """A worker of one slot, with further REFINE_ settings; afterwards nothing of it may be left."""
    environment = {
        "REFINE_DEVICES": "cpu",
        "REFINE_SLOTS_PER_DEVICE": "1",
        "REFINE_THREADS_PER_SLOT": "1",
        **workplace.environment,
        **{f"REFINE_{name.upper()}": value for name, value in settings.items()},
    }
    with (folder / "output").open("wb") as output, (folder / "logs").open("wb") as logs:
        process = subprocess.Popen(
            [sys.executable, "-m", "refine_worker"],
            env=os.environ | environment,
            stdout=output,
            stderr=logs,
        )
    worker = Worker(workplace, process, folder / "output", folder / "logs")
    seen: list[psutil.Process] = []
    try:
        worker.wait_until_ready()
        seen = worker.tree()
        yield worker
        if process.poll() is None:
            seen = worker.tree()
            worker.stop()
    finally:
        process.kill()
        process.wait()
    _, alive = psutil.wait_procs(seen, timeout=20)
    assert not alive, f"left over: {alive}"
