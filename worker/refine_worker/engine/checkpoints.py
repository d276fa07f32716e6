"""The state of a running job in the blob store: if its slot is lost, another one goes on from there."""

from __future__ import annotations

import hashlib
import io
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch

import refine_engine
from refine_engine.errors import RefineError
from refine_engine.method.loop import Snapshot
from refine_jobs import keys
from refine_jobs.blobs import BlobNotFound, BlobStore, BlobStoreFailed

_LARGEST_SHARE = 0.02  # of a run's time that checkpoints may take

log = logging.getLogger(__name__)


class BlobCheckpoints:
    """Checkpoints of one job, the latest only.

    Slots that both believe to have the job may write it one after the other: the same job on the same device
    goes through the same states, so any of them will do.
    """

    def __init__(self, blobs: BlobStore, job_id: str, device: torch.device, every_s: float) -> None:
        self._blobs, self._device, self._every_s = blobs, device, every_s
        self._job_id, self._name = job_id, keys.checkpoint_blob(job_id)
        self._next = time.monotonic() + every_s

    def last(self) -> Snapshot | None:
        """None also for that of other code or another device, with which the result would be another one."""
        try:
            data = self._blobs.get(self._name)
        except BlobNotFound:
            return None
        found = torch.load(io.BytesIO(data), map_location=self._device, weights_only=True)
        if found["made_by"] != _maker(self._device):
            log.info("the checkpoint is of %s: the run begins anew", found["made_by"])
            return None
        snapshot: Snapshot = found["snapshot"]
        log.info("the run goes on from iteration %d", snapshot["iteration"])
        return snapshot

    def due(self) -> bool:
        """Some seconds after the one before."""
        return time.monotonic() >= self._next

    def keep(self, snapshot: Snapshot) -> None:
        """Write it; without room it is left out."""
        started = time.monotonic()
        file = io.BytesIO()
        torch.save({"made_by": _maker(self._device), "snapshot": snapshot}, file)
        try:
            self._blobs.put(self._name, file.getvalue())
        except BlobStoreFailed as error:
            log.warning("no checkpoint: %s", error)
        now = time.monotonic()
        self._next = now + max(self._every_s, (now - started) / _LARGEST_SHARE)

    def forget(self) -> None:
        """Nobody will go on from it."""
        self._blobs.delete_folder(keys.checkpoint_folder(self._job_id))


@contextmanager
def checkpoints_of(
    blobs: BlobStore, job_id: str, device: torch.device, every_s: float
) -> Iterator[BlobCheckpoints]:
    """Gone once the job has ended, in whichever way; there still if the run was only interrupted."""
    checkpoints = BlobCheckpoints(blobs, job_id, device, every_s)
    try:
        yield checkpoints
    except RefineError:
        checkpoints.forget()
        raise
    checkpoints.forget()


def _maker(device: torch.device) -> str:
    """All that decides about the result beside the job: code, libraries, device, threads."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    return f"code {_code()[:16]}, torch {torch.__version__}, {name}, threads {torch.get_num_threads()}"


@cache
def _code() -> str:
    """SHA-256 of the engine's sources: versions of one number may differ."""
    folder = Path(refine_engine.__file__).parent
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(folder.rglob("*.py")))).hexdigest()
