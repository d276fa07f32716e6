"""What the job store is to do, in memory: the same calls on plain dictionaries, at once and without Redis."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from refine_jobs import keys
from refine_jobs.settings import JobSettings
from refine_jobs.share import Share
from refine_proto.errors import Expired, NotFound, QueueFull, QuotaExceeded, RefineError
from refine_proto.models import State

HELD = (State.RUNNING, State.CANCELLING)
ENDED = (State.SUCCEEDED, State.FAILED, State.CANCELLED)


@dataclass
class ModelJob:
    """One job. Times in seconds of JobModel.now_s."""

    id: str
    owner: str
    content: str
    number: int
    share: Share
    tag: float = 0  # the queue's order
    state: State = State.QUEUED
    attempt: int = 0
    lost: int = 0  # slots
    deleted: bool = False
    lease_ends_s: float = 0
    expires_s: float = 0
    missing_since_s: float | None = None  # in RQ's queue
    events: list[tuple[str, State]] = field(default_factory=list)

    @property
    def kept(self) -> bool:
        """Whether it has a record that can be read."""
        return not self.deleted and self.state is not State.EXPIRED

    @property
    def queued(self) -> bool:
        return self.kept and self.state is State.QUEUED

    @property
    def is_question(self) -> bool:
        return self.share.flow.endswith(":question")

    @property
    def next_delivery(self) -> str:
        """RQ's id of it."""
        return f"{self.id}-{self.attempt + 1}"

    def tell(self, kind: str) -> None:
        self.events.append((kind, self.state))

    def holds(self, attempt: int) -> bool:
        return self.state in HELD and self.attempt == attempt


class JobModel:
    """All jobs, newest last, RQ's queue and the trash."""

    def __init__(self, settings: JobSettings) -> None:
        self._settings, self._numbers = settings, itertools.count()
        self.now_s = 0.0
        self.jobs: dict[str, ModelJob] = {}
        self.deliveries: list[str] = []
        self.virtual_time = 0.0
        self.flows: dict[str, float] = {}  # where the next job of each may start
        self.trash: set[str] = set()
        self._ids: dict[tuple[str, str], str] = {}  # by owner and idempotency key

    def kept(self) -> Iterator[ModelJob]:
        return (job for job in self.jobs.values() if job.kept)

    def queue(self) -> list[ModelJob]:
        """The queued jobs in the order in which they are to start."""
        return sorted((job for job in self.kept() if job.queued), key=lambda job: (job.tag, job.id))

    def no_room(self, owner: str) -> type[RefineError] | None:
        queued = [job.owner for job in self.jobs.values() if job.queued]
        if len(queued) >= self._settings.max_queued:
            return QueueFull
        return QuotaExceeded if queued.count(owner) >= self._settings.max_queued_per_owner else None

    def refusal(self, job: ModelJob, owner: str) -> type[RefineError] | None:
        """What every call about the job says to who may not make it."""
        if job.deleted or job.owner != owner:
            return NotFound
        return None if job.kept else Expired

    def submit(self, upload: str, owner: str, key: str | None, content: str, share: Share) -> ModelJob:
        """The job of the upload, or that of an earlier one with the same key."""
        known = self.jobs.get(self._ids.get((owner, key or ""), ""))
        if known is not None and known.kept:
            self.trash.add(upload)
            return known
        job = self.jobs[upload] = ModelJob(upload, owner, content, next(self._numbers), share)
        if key:
            self._ids[owner, key] = upload
        start = max(self.virtual_time, self.flows.get(share.flow, 0))
        self.flows[share.flow] = start + share.charge_ms
        self.virtual_time += 1
        job.tag = start - share.head_start_ms
        self._deliver(job)
        job.tell("state")
        return job

    def cancel(self, job: ModelJob) -> None:
        if job.state is State.QUEUED:
            self.end(job, State.CANCELLED)
            self._withdraw(job)
        elif job.state is State.RUNNING:
            job.state = State.CANCELLING
            job.tell("state")

    def delete(self, job: ModelJob) -> None:
        if job.state is State.QUEUED:
            job.state = State.EXPIRED
            job.tell("completed")
            self._withdraw(job)
        job.deleted = True
        self.trash.add(job.id)

    def claim(self, job: ModelJob) -> bool:
        """Whether it could be started."""
        if not job.queued:
            return False
        job.attempt, job.state, job.missing_since_s = job.attempt + 1, State.RUNNING, None
        self.virtual_time = max(self.virtual_time, job.tag)
        self._forget_flows()
        job.tell("state")
        self.renew(job)
        return True

    def renew(self, job: ModelJob) -> None:
        job.lease_ends_s = self.now_s + self._settings.lease_s

    def end(self, job: ModelJob, state: State) -> None:
        job.state, job.expires_s = state, self.now_s + self._settings.retention_s
        job.tell("completed")

    def give_back(self, job: ModelJob) -> None:
        if job.state is State.CANCELLING:
            self.end(job, State.CANCELLED)
        elif job.lost >= self._settings.max_attempts:
            self.end(job, State.FAILED)
        else:
            job.state = State.QUEUED
            job.tag = min(job.tag, self.virtual_time)
            self._deliver(job)
            job.tell("state")

    def take_back_lost(self) -> list[tuple[str, State]]:
        lost = [job for job in self.jobs.values() if job.state in HELD and job.lease_ends_s <= self.now_s]
        lost.sort(key=lambda job: (job.lease_ends_s, job.id))
        for job in lost:
            job.lost += 1
            self.give_back(job)
        return [(job.id, job.state) for job in lost]

    def requeue_missing(self) -> list[str]:
        requeued = []
        for job in self.queue():
            if job.next_delivery in self.deliveries:
                continue
            if job.missing_since_s is None:
                job.missing_since_s = self.now_s
            elif self.now_s - job.missing_since_s >= keys.MISSING_S:
                job.missing_since_s = None
                self._deliver(job)
                requeued.append(job.id)
        return requeued

    def expire(self) -> set[str]:
        due = [job for job in self.kept() if job.state in ENDED and job.expires_s <= self.now_s]
        for job in due:
            job.state = State.EXPIRED
            self.trash.add(job.id)
        return {job.id for job in due}

    def _deliver(self, job: ModelJob) -> None:
        """Before the next queued one that RQ has."""
        queue = self.queue()
        behind = [other.next_delivery for other in queue[queue.index(job) + 1 :]]
        place = next((self.deliveries.index(d) for d in behind if d in self.deliveries), len(self.deliveries))
        self.deliveries.insert(place, job.next_delivery)

    def _withdraw(self, job: ModelJob) -> None:
        """The rest of its flow moves up."""
        self.deliveries = [other for other in self.deliveries if other != job.next_delivery]
        behind = [o for o in self.queue() if o.share.flow == job.share.flow and o.number > job.number]
        for other in behind:
            other.tag -= job.share.charge_ms
        if job.share.flow in self.flows:
            self.flows[job.share.flow] -= job.share.charge_ms
        self._forget_flows()
        if behind:
            places = {other.next_delivery: (other.tag, other.id) for other in self.queue()}
            self.deliveries.sort(key=lambda d: places.get(d, (-math.inf, "")))

    def _forget_flows(self) -> None:
        if not self.queue():
            self.flows.clear()
