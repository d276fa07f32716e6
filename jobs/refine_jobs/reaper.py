"""What must be put right now and then: lost workers, lost deliveries, old data. Run by the worker process."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass

from refine_proto.models import State

from . import keys
from .blobs import BlobStore
from .worker_store import WorkerStore

PERIOD_S = 15.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reaped:
    """What one round has done."""

    taken_back: tuple[tuple[str, State], ...]  # job id, state it is in now
    requeued: tuple[str, ...]
    expired: tuple[str, ...]
    blobs_deleted: int
    swept: int  # folders of blobs without a job


def reap(store: WorkerStore, blobs: BlobStore) -> Reaped:
    """One round. Any number of processes may do it at the same time, any of them may die half way."""
    taken_back = tuple(store.take_back_lost())
    requeued = tuple(store.requeue_missing())
    expired = tuple(store.expire())
    deleted = 0
    for job_id in store.trash():
        deleted += blobs.delete_folder(keys.blob_folder(job_id))
        store.trash_deleted(job_id)
    for job_id, state in taken_back:
        log.warning("job %s lost its worker and is now %s", job_id, state)
    for job_id in requeued:
        log.warning("job %s was not in RQ any more and is queued again", job_id)
    return Reaped(taken_back, requeued, expired, deleted, sweep(store, blobs) if store.sweep_due() else 0)


def sweep(store: WorkerStore, blobs: BlobStore) -> int:
    """Delete the blobs of jobs that Redis has forgotten, as after a failover; the number of jobs."""
    old = [
        job_id
        for job_id in store.without_job(blobs.folders(keys.BLOBS))
        if time.time() - blobs.changed_at(keys.blob_folder(job_id)) > store.longest_life_s
    ]
    for job_id in old:
        blobs.delete_folder(keys.blob_folder(job_id))
        log.warning("blobs without a job: %s is deleted", keys.blob_folder(job_id))
    return len(old)
