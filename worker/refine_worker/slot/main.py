"""`python -m refine_worker.slot.main PLAN DESCRIPTOR`: a slot, an RQ worker without fork and torch."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from types import FrameType
from typing import Any

from rq import Queue, SimpleWorker
from rq.job import Job as RqJob
from rq.serializers import JSONSerializer

from refine_jobs.blobs import BlobStore
from refine_jobs.delivery import FORMER_TASK, TASK, worker_queue
from refine_jobs.logs import configure_logs
from refine_jobs.redis_server import connect, connect_for_rq
from refine_jobs.settings import JobSettings
from refine_jobs.worker_store import WorkerStore
from refine_proto.tracing import tracing

from ..lifeline import stop_with_parent
from ..plan import NEVER_READY, SlotPlan
from ..reports import Reports
from ..settings import WorkerSettings
from .engine_process import EngineProcess, EngineStartFailed
from .slot import SLOT, Slot

_IDLE_LOOK_S = 5  # between two looks at an idle engine process

log = logging.getLogger("refine_worker.slot.slot")


class SlotJob(RqJob):
    """Whoever can write to Redis can name any function in a job; this slot runs one."""

    def perform(self) -> Any:
        if self.func_name == FORMER_TASK:
            self.func_name = TASK
        if self.func_name != TASK:
            raise PermissionError(f"expected a job for {TASK}, got {self.func_name!r:.80}")
        return super().perform()


class SlotWorker(SimpleWorker):
    """RQ's worker, with an engine process that is warm before each job, and our way to stop."""

    def dequeue_job_and_maintain_ttl(
        self, timeout: int | None, max_idle_time: int | None = None
    ) -> tuple[RqJob, Queue] | None:
        """Wait for a job, and see now and then whether the engine process still waits too."""
        while True:
            SLOT.get().prepare()
            SLOT.get().wait_for_blobs()
            found = super().dequeue_job_and_maintain_ttl(timeout, max_idle_time=_IDLE_LOOK_S)
            if found is not None:
                return found

    def execute_job(self, job: RqJob, queue: Queue) -> None:
        slot = SLOT.get()
        slot.prepare()
        super().execute_job(job, queue)
        if slot.stop_at is None:
            slot.prepare()  # now, and not when the next job waits for it

    def handle_warm_shutdown_request(self) -> None:
        log.info("stopping: a running job has %g s to end", SLOT.get().settings.stop_grace_s)
        SLOT.get().drain()

    def request_force_stop(self, signum: int, frame: FrameType | None) -> None:
        raise SystemExit("stopped at once")


def main(argv: Sequence[str] = sys.argv) -> int:
    """Run a slot until it is told to stop: 0, NEVER_READY, or 1 if a later engine process cannot start."""
    plan = SlotPlan.model_validate_json(argv[1])
    configure_logs(slot=plan.name)
    stop_with_parent()
    jobs, settings = JobSettings.from_environment(), WorkerSettings.from_environment()
    assert jobs.redis_url is not None, "the supervisor has checked that"
    url = jobs.redis_url.get_secret_value()
    reports = Reports(int(argv[2]))
    engine = EngineProcess(plan, settings, jobs.blob_location, reports.tell)
    slot = Slot(
        plan, WorkerStore(connect(url), jobs), engine, BlobStore(jobs.blob_location), settings, reports.tell
    )
    SLOT.set(slot)
    ended_early = NEVER_READY
    try:
        with tracing("refine-worker"):
            slot.prepare()
            ended_early = 1
            print(f"slot {plan.name}: ready on {plan.device}, threads: {plan.threads}", flush=True)
            rq_connection = connect_for_rq(url)
            worker = SlotWorker(
                [worker_queue(rq_connection, jobs.pool)],
                connection=rq_connection,
                job_class=SlotJob,
                serializer=JSONSerializer,
            )
            worker.work(logging_level="WARNING")
    except EngineStartFailed as error:
        log.error("%s", error)
        return ended_early
    finally:
        slot.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
