"""A job whose slot is lost goes on from its last checkpoint, and ends as if it had not been disturbed."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

from worker_process import wait_until

from refine_jobs import keys
from refine_proto.models import State

if TYPE_CHECKING:
    from worker_process import StartWorker, Workplace

    from refine_jobs.record import Job


def refined(job: Job) -> str:
    """SHA-256 of the mesh."""
    assert job.state is State.SUCCEEDED, job.error
    return next(artifact.sha256 for artifact in job.artifacts if artifact.name == "refined.glb")


def kept(workplace: Workplace, job_id: str) -> bool:
    """Whether there is a checkpoint."""
    return "checkpoint" in workplace.blobs.folders(keys.blob_folder(job_id))


def test_another_slot_goes_on_where_the_lost_one_was(start_worker: StartWorker, workplace: Workplace) -> None:
    with start_worker(workplace, checkpoint_s="0.1") as worker:
        undisturbed = workplace.ended(workplace.submit(iterations=60))
        job_id = workplace.submit(iterations=60)
        wait_until(lambda: kept(workplace, job_id), "a checkpoint")
        os.kill(worker.slot_pid(), signal.SIGKILL)
        workplace.taken_back(job_id, 1)
        job = workplace.ended(job_id)
        assert job.attempt == 2
        assert refined(job) == refined(undisturbed)
        assert [line["job_id"] for line in worker.logs if "goes on from" in line["message"]] == [job_id]
    assert not kept(workplace, job_id)
