"""JobStore: jobs as the edge sees them. Asynchronous; every answer is the owner's or NOT_FOUND.

Each change is one Lua script (lua/), so that no crash and no race leaves a job half way. The worker's side of
the same records is worker_store.py.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import secrets
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any

from redis.asyncio import Redis

from refine_proto.errors import (
    Conflict,
    Expired,
    IdempotencyKeyReused,
    InvalidInput,
    NotFound,
    OptionsInvalid,
    QueueFull,
    QuotaExceeded,
    Unavailable,
)
from refine_proto.lists import RefinementFilter
from refine_proto.models import Event, FieldError, Refinement, RefinementPage, RefinementSpec, State

from . import keys
from .delivery import delivery_of
from .durable import Durable
from .feed import EventFeed
from .load import LOAD_VALUES, ask_load, read_load
from .record import Job, Submission, Task, encode, to_json
from .redis_server import RETRY_S, unavailable
from .scripts import Clock, Scripts
from .settings import JobSettings
from .share import Share

_LOOK = 100  # records that a list reads at a time; the longest page
_MOST_LOOKS = 10  # of one page
_ALL = RefinementFilter()
_BUSY_RETRY_S = 10.0  # queue full: a job takes longer than this


@dataclass(frozen=True)
class Submitted:
    """The answer to submit."""

    refinement: Refinement
    replayed: bool  # the answer that an earlier submission with the same idempotency key had


class JobStore:
    """All that the edge does with jobs. Raises the errors of refine_proto.errors."""

    def __init__(self, redis: Redis, settings: JobSettings, clock: Clock | None = None) -> None:
        self._redis: Any = redis  # redis-py's types cannot say that it decodes responses
        self._settings = settings
        self._delivery = delivery_of(settings.pool)
        self.feed = EventFeed(redis, self._find)
        self._scripts = Scripts(redis, clock)
        self._durable = Durable(redis) if settings.sync_submissions else None

    @property
    def queue(self) -> str:
        """Name of RQ's queue."""
        return str(self._delivery.queue.name)

    async def close(self) -> None:
        """Stop the event feed and close the connections."""
        await self.feed.close()
        await self._redis.aclose()

    def check_options(self, spec: RefinementSpec) -> RefinementSpec:
        """The spec with effective options; raises OptionsInvalid for what this server does not allow."""
        limit_s = self._settings.job_timeout_s
        timeout_s = spec.options.timeout_s or limit_s
        if timeout_s > limit_s:
            detail = f"expected timeout_s of at most {limit_s:g} on this server, got {timeout_s:g}"
            raise OptionsInvalid(detail, errors=[FieldError(pointer="/options/timeout_s", detail=detail)])
        return spec.model_copy(update={"options": spec.options.model_copy(update={"timeout_s": timeout_s})})

    @unavailable
    async def begin_upload(self, owner: str) -> str:
        """A new id, under which the caller may write the input blobs before `submit`.

        Refuses early what submit would refuse for lack of room. Blobs of an upload that is never submitted
        are removed after keys.UPLOAD_S.
        """
        job_id = secrets.token_hex(16)
        limits = (self._settings.max_queued, self._settings.max_queued_per_owner)
        self._check_room(await self._scripts.run("begin", job_id, owner, *limits))
        return job_id

    @unavailable
    async def discard_upload(self, job_id: str) -> None:
        """Forget an upload that will not be submitted; its blobs go soon."""
        async with self._redis.pipeline(transaction=True) as pipe:
            pipe.zrem(keys.UPLOADS, job_id)
            pipe.sadd(keys.TRASH, job_id)
            await pipe.execute()

    @unavailable
    async def submit(self, submission: Submission) -> Submitted:
        """Queue a job, or give the first answer again for the same idempotency key and content.

        Raises IdempotencyKeyReused for the same key with other content, QueueFull and QuotaExceeded, and
        Unavailable where Redis does not say that it has it on its disk: it may be queued then. In every
        case but a new job the blobs of the submission are removed.
        """
        settings, spec = self._settings, self.check_options(submission.spec)
        record = encode(
            {
                "spec": spec,
                "task": submission.task,
                "pool": settings.pool,
                **vars(Share.of(submission)),
                "mesh": submission.mesh,
                "silhouette": submission.silhouette,
                "more_files": submission.more_files or None,
                "request_id": submission.request_id,
                "traceparent": submission.traceparent,
            }
        )
        timeout_s = spec.options.timeout_s or settings.job_timeout_s
        outcome, job_id = await self._scripts.run(
            "submit",
            submission.id,
            submission.owner,
            self._idempotency_key(submission),
            _fingerprint(submission),
            int(settings.idempotency_s * 1000),
            settings.max_queued,
            settings.max_queued_per_owner,
            int(settings.retention_s * 1000),
            len(record),
            *record,
            *self._delivery.enqueue(submission.id, 1, timeout_s),
        )
        self._check_room(outcome)
        if outcome == "reused":
            raise IdempotencyKeyReused(
                f"the idempotency key belongs to refinement {job_id} with other content; use a new key"
            )
        if outcome == "upload_gone":
            raise Unavailable(
                "the upload took too long and was removed; send it again", retry_after_s=RETRY_S
            )
        if self._durable and submission.task is Task.REFINE:
            await self._durable.written()
        return Submitted(await self.get(submission.owner, job_id), outcome == "replayed")

    @unavailable
    async def get(self, owner: str, job_id: str) -> Refinement:
        """One refinement; raises NotFound, also for another owner's, and Expired."""
        async with self._redis.pipeline(transaction=False) as pipe:
            pipe.hgetall(keys.JOB + job_id)
            pipe.zrank(keys.QUEUED, job_id)
            ask_load(pipe)
            fields, rank, *load = await pipe.execute()
        job = _owned(owner, job_id, fields)
        return job.refinement(rank, read_load(load).eta_s(job, rank))

    @unavailable
    async def answer(self, owner: str, job_id: str) -> Mapping[str, Any] | None:
        """What a worker has answered to a question; None where it did something else."""
        return (await self._job(owner, job_id)).answer

    @unavailable
    async def list(
        self,
        owner: str,
        limit: int = 20,
        cursor: str | None = None,
        wanted: RefinementFilter = _ALL,
    ) -> RefinementPage:
        """The owner's refinements that are wanted, newest first; `cursor`: `next_cursor` of the page before.

        A page holds fewer than `limit`, perhaps none, if few of many records are wanted: follow the cursor.
        """
        below = f"({_number(cursor)}" if cursor else "+inf"
        found: list[Refinement] = []
        for _ in range(_MOST_LOOKS):
            # One more than are looked at, which tells whether there is another page.
            entries = await self._redis.zrange(
                keys.OWNER + owner,
                below,
                "-inf",
                byscore=True,
                desc=True,
                offset=0,
                num=_LOOK + 1,
                withscores=True,
            )
            looked_at = entries[: limit if wanted.takes_all else _LOOK]
            shown = await self._read([job_id for job_id, _ in looked_at])
            for place, ((_, number), refinement) in enumerate(zip(looked_at, shown, strict=True), 1):
                if refinement is not None and wanted.takes(refinement):
                    found.append(refinement)
                if len(found) == limit:
                    more = place < len(entries)
                    return RefinementPage(refinements=found, next_cursor=_cursor(number) if more else None)
            if len(looked_at) == len(entries):
                return RefinementPage(refinements=found)
            below = f"({int(looked_at[-1][1])}"
        return RefinementPage(refinements=found, next_cursor=_cursor(looked_at[-1][1]))

    async def _read(self, job_ids: Sequence[str]) -> Sequence[Refinement | None]:
        """None for a question, for one that only a newer version can read, and for one removed meanwhile."""
        async with self._redis.pipeline(transaction=False) as pipe:
            for job_id in job_ids:
                pipe.hgetall(keys.JOB + job_id)
                pipe.zrank(keys.QUEUED, job_id)
            ask_load(pipe)
            values = await pipe.execute()
        load, values = read_load(values[-LOAD_VALUES:]), values[:-LOAD_VALUES]
        read = ((Job.read(fields), rank) for fields, rank in zip(values[::2], values[1::2], strict=True))
        return [
            job.refinement(rank, load.eta_s(job, rank)) if job and job.task is Task.REFINE else None
            for job, rank in read
        ]

    async def watch(self, owner: str, job_id: str, after_sequence: int = 0) -> AsyncGenerator[Event, None]:
        """The events after a sequence number, past and to come; ends after the completed one.

        Raises NotFound and Expired on the first step.
        """
        job = await self._job(owner, job_id)
        if job.state.terminal and after_sequence >= job.sequence:
            return
        async with aclosing(self.feed.follow(job, after_sequence)) as events:
            async for event in events:
                yield event

    @unavailable
    async def cancel(self, owner: str, job_id: str) -> Refinement:
        """Queued: cancelled at once; running: cancelling; otherwise unchanged."""
        job = await self._job(owner, job_id)
        retention_ms = int(self._settings.retention_s * 1000)
        withdraw = delivery_of(job.pool or self._settings.pool).withdraw(job_id, job.attempt + 1)
        await self._scripts.run("cancel", job_id, retention_ms, *withdraw)
        return await self.get(owner, job_id)

    @unavailable
    async def extend(self, owner: str, job_id: str, lifetime_s: float) -> Refinement:
        """Keep an ended job for so long from now on; raises Conflict before its end, and InvalidInput."""
        longest_s = self._settings.max_retention_s
        if not 0 < lifetime_s <= longest_s:
            detail = (
                f"expected lifetime_s above 0 and of at most {longest_s:g} on this server, got {lifetime_s:g}"
            )
            raise InvalidInput(detail, errors=[FieldError(pointer="/lifetime_s", detail=detail)])
        job = await self._job(owner, job_id)
        if not await self._scripts.run("extend", job_id, int(lifetime_s * 1000)):
            await self._job(owner, job_id)  # says whether it is gone
            raise Conflict(f"refinement {job_id} is {job.state}; its lifetime begins with its end")
        return await self.get(owner, job_id)

    @unavailable
    async def delete(self, owner: str, job_id: str) -> None:
        """Remove the record now and the blobs soon; raises Conflict while a worker has the job."""
        job = await self._job(owner, job_id)
        withdraw = delivery_of(job.pool or self._settings.pool).withdraw(job_id, job.attempt + 1)
        outcome = await self._scripts.run("delete", job_id, *withdraw)
        if outcome == "held":
            raise Conflict(
                f"refinement {job_id} is running; cancel it and wait for its end before deleting it"
            )
        if outcome == "gone":
            await self._job(owner, job_id)  # says how

    async def _job(self, owner: str, job_id: str) -> Job:
        return _owned(owner, job_id, await self._redis.hgetall(keys.JOB + job_id))

    async def _find(self, job_id: str) -> Refinement | None:
        """None also for a record that only a newer version can read: its watchers still hear of its end."""
        job = Job.read(await self._redis.hgetall(keys.JOB + job_id))
        return job.refinement() if job else None

    def _idempotency_key(self, submission: Submission) -> str:
        key = submission.idempotency_key
        return keys.idempotency(submission.owner, _sha256(key)) if key else ""

    def _check_room(self, outcome: str) -> None:
        """Raise what `no_room` of the scripts has found."""
        if outcome == "queue_full":
            raise QueueFull(
                f"the queue holds {self._settings.max_queued} jobs, its limit; try again later",
                retry_after_s=_BUSY_RETRY_S,
            )
        if outcome == "quota":
            raise QuotaExceeded(
                f"you have {self._settings.max_queued_per_owner} queued jobs, your limit; "
                "wait for some to start",
                retry_after_s=_BUSY_RETRY_S,
            )


def _owned(owner: str, job_id: str, fields: dict[str, str]) -> Job:
    if not fields or fields["owner"] != owner:
        raise NotFound(f"there is no refinement {job_id[:64]}")
    if fields["state"] == State.EXPIRED:
        raise Expired(f"refinement {job_id} has expired; its data is gone")
    return Job.decode(fields)


def _fingerprint(submission: Submission) -> str:
    """The same for the same files and the same spec, however it was written."""
    more = [dict(sorted(submission.more_files.items()))] if submission.more_files else []
    return _sha256(to_json([submission.spec, submission.mesh, submission.silhouette, *more]))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _cursor(number: float) -> str:
    return base64.urlsafe_b64encode(str(int(number)).encode()).decode().rstrip("=")


def _number(cursor: str) -> int:
    try:
        return int(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, binascii.Error):
        detail = f"expected the next_cursor of an earlier page, got {cursor[:40]!r}"
        raise InvalidInput(detail, errors=[FieldError(pointer="/cursor", detail=detail)]) from None
