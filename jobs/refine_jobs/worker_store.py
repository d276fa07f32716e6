"""WorkerStore: jobs as a worker slot and the reaper see them. Synchronous, safe to use from several threads.

`attempt` of a claimed job is its fencing token: every write names it, and a worker whose lease ran out and
whose job went on without it gets LeaseLost instead of overwriting anything.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import BaseModel
from redis import Redis

from refine_proto.errors import RefineError, WorkerLost
from refine_proto.models import Artifact, Finding, Judgement, Progress, State

from . import keys
from .delivery import delivery_id, delivery_of
from .record import Job, encode, pairs, to_json
from .scripts import Clock, Scripts
from .settings import JobSettings
from .slots import SlotStatus


class LeaseLost(Exception):
    """The job went on without this worker: stop, and write nothing."""


class WorkerStore:
    """All that workers do with jobs."""

    def __init__(self, redis: Redis, settings: JobSettings, clock: Clock | None = None) -> None:
        self._redis: Any = redis  # redis-py's types cannot say that it decodes responses
        self._settings = settings
        self._delivery = delivery_of(settings.pool)
        self._clock = clock
        self._scripts = Scripts(redis, clock)

    @property
    def queue(self) -> str:
        """Name of RQ's queue."""
        return str(self._delivery.queue.name)

    # ---- a slot ----

    def claim(self, job_id: str, slot: str) -> Job | None:
        """Start the job, or None if it is not queued (any more): then do nothing."""
        fields = self._run("claim", job_id, slot, self._lease_ms)
        return Job.decode(pairs(fields)) if fields else None

    def renew(self, job: Job) -> State:
        """Keep the job for another lease_s; RUNNING, or CANCELLING when it shall stop. Raises LeaseLost."""
        return self._held(job, self._run("renew", job.id, job.attempt, self._lease_ms, ""))

    def report(self, job: Job, progress: Progress) -> State:
        """As renew, with progress for the watchers."""
        return self._held(job, self._run("renew", job.id, job.attempt, self._lease_ms, to_json(progress)))

    def finish(
        self, job: Job, artifacts: Sequence[Artifact], judgement: Judgement, checks: Sequence[Finding] = ()
    ) -> None:
        """The job succeeded; its artifacts are in the blob store (keys.artifact_blob). Raises LeaseLost."""
        fields = {"artifacts": list(artifacts), "checks": list(checks), **dict(judgement)}
        self._end(job, State.SUCCEEDED, "", encode(fields))

    def answer(self, job: Job, answer: BaseModel) -> None:
        """The job was a question, and this is the answer. Raises LeaseLost."""
        self._end(job, State.SUCCEEDED, "", encode({"answer": answer}))

    def fail(self, job: Job, error: RefineError) -> None:
        """The job failed for good. Raises LeaseLost."""
        problem = error.problem(request_id=job.request_id)
        self._end(job, State.FAILED, error.reason, encode({"error": problem}))

    def cancelled(self, job: Job) -> None:
        """The job has stopped, as was asked for. Raises LeaseLost."""
        self._end(job, State.CANCELLED, "", [])

    def give_back(self, job: Job, why: str) -> State:
        """The slot cannot go on, through no fault of the job: queue it again, at its place.

        Returns QUEUED, or CANCELLED if it was to be cancelled. Raises LeaseLost.
        """
        return self._held(job, self._give_back(job, "now", WorkerLost(why)))

    def lose(self, job: Job, error: RefineError) -> State:
        """The attempt is lost, perhaps by the job's own doing: queue it again, if it may lose one.

        Returns QUEUED, CANCELLED if it was to be cancelled, or FAILED, with `error`. Raises LeaseLost.
        """
        return self._held(job, self._give_back(job, "lost", error))

    def show(self, slot: SlotStatus) -> None:
        """Say that the slot is alive; call it at least every keys.SLOT_S / 3 seconds."""
        seconds, _ = self._redis.time()
        with self._redis.pipeline(transaction=True) as pipe:
            pipe.set(keys.SLOT + slot.name, slot.model_dump_json(), ex=keys.SLOT_S)
            pipe.zadd(keys.SLOTS, {slot.name: seconds + keys.SLOT_S})
            pipe.zremrangebyscore(keys.SLOTS, "-inf", seconds)
            pipe.execute()

    def hide(self, slot_name: str) -> None:
        """The slot ends."""
        with self._redis.pipeline(transaction=True) as pipe:
            pipe.delete(keys.SLOT + slot_name)
            pipe.zrem(keys.SLOTS, slot_name)
            pipe.execute()

    # ---- the reaper (reaper.py) ----

    def take_back_lost(self) -> list[tuple[str, State]]:
        """Queue again, or fail, the running jobs whose lease ran out; (id, new state) of each."""
        taken = []
        for job in self._jobs(self._due(keys.LEASES)):
            why = f"its worker slot {job.slot} stopped answering during attempt {job.attempt}"
            state = self._give_back(job, "expired", WorkerLost(why))
            if state is not None:
                taken.append((job.id, State(state)))
        return taken

    def requeue_missing(self) -> list[str]:
        """Enqueue again this pool's queued jobs that RQ has not known for keys.MISSING_S; their ids."""
        known = set(self._redis.lrange(self._delivery.queue.key, 0, -1))
        queued = self._redis.zrange(keys.QUEUED, 0, -1)
        with self._redis.pipeline(transaction=False) as pipe:
            for job_id in queued:
                pipe.hmget(keys.JOB + job_id, "attempt", "pool")
            found = pipe.execute()
        missing = [
            job_id
            for job_id, (attempt, pool) in zip(queued, found, strict=True)
            if pool in (None, self._settings.pool) and delivery_id(job_id, int(attempt or 0) + 1) not in known
        ]
        return [
            job.id
            for job in self._jobs(missing)
            if self._run("requeue", job.id, job.attempt, *self._enqueue(job))
        ]

    def expire(self) -> list[str]:
        """Turn jobs past their lifetime into tombstones and old uploads into trash; ids of the jobs."""
        for upload in self._due(keys.UPLOADS, keys.UPLOAD_S):
            with self._redis.pipeline(transaction=True) as pipe:
                pipe.zrem(keys.UPLOADS, upload)
                pipe.sadd(keys.TRASH, upload)
                pipe.execute()
        tombstone_ms = int(self._settings.tombstone_s * 1000)
        return [job_id for job_id in self._due(keys.EXPIRY) if self._run("expire", job_id, tombstone_ms)]

    def trash(self) -> set[str]:
        """Ids of jobs whose blobs are to be deleted."""
        return set(self._redis.smembers(keys.TRASH))

    def trash_deleted(self, job_id: str) -> None:
        """The blobs of the job are gone."""
        self._redis.srem(keys.TRASH, job_id)

    def sweep_due(self) -> bool:
        """Whether nobody has looked for blobs without a job for keys.SWEEP_S; the caller does it now."""
        return bool(self._redis.set(keys.SWEPT, "", nx=True, ex=keys.SWEEP_S))

    def without_job(self, job_ids: Sequence[str]) -> list[str]:
        """Those of which Redis knows nothing: no record, no upload, no trash."""
        with self._redis.pipeline(transaction=False) as pipe:
            for job_id in job_ids:
                pipe.exists(keys.JOB + job_id)
                pipe.zscore(keys.UPLOADS, job_id)
                pipe.sismember(keys.TRASH, job_id)
            answers = iter(pipe.execute())
        known = zip(answers, answers, answers, strict=True)
        return [
            job_id
            for job_id, (record, upload, trash) in zip(job_ids, known, strict=True)
            if not record and upload is None and not trash
        ]

    @property
    def longest_life_s(self) -> float:
        """Of blobs whose job has left no trace: younger ones may belong to a Redis that is not this one."""
        return self._settings.retention_s + keys.UPLOAD_S

    # ---- helpers ----

    @property
    def _lease_ms(self) -> int:
        return int(self._settings.lease_s * 1000)

    @property
    def _retention_ms(self) -> int:
        return int(self._settings.retention_s * 1000)

    def _run(self, name: str, *args: Any) -> Any:
        return self._scripts.run(name, *args)

    def _held(self, job: Job, state: str | None) -> State:
        if state is None:
            raise LeaseLost(f"job {job.id}: attempt {job.attempt} no longer holds it")
        return State(state)

    def _end(self, job: Job, state: State, reason: str, fields: list[str]) -> None:
        done = self._run("finish", job.id, job.attempt, state, reason, self._retention_ms, *fields)
        self._held(job, state if done else None)

    def _give_back(self, job: Job, when: str, error: RefineError) -> str | None:
        attempts = self._settings.max_attempts
        last = type(error)(f"{error.detail}; that was the last of {attempts} attempts that it may lose")
        state: str | None = self._run(
            "give_back",
            job.id,
            job.attempt,
            when,
            attempts,
            self._retention_ms,
            last.reason,
            to_json(last.problem(request_id=job.request_id)),
            *self._enqueue(job),
        )
        return state

    def _enqueue(self, job: Job) -> list[Any]:
        return delivery_of(job.pool or self._settings.pool).enqueue(job.id, job.attempt + 1, job.timeout_s)

    def _due(self, key: str, age_s: int = 0) -> list[str]:
        until = self._now_ms() - age_s * 1000
        due: list[str] = self._redis.zrange(key, "-inf", until, byscore=True, offset=0, num=1000)
        return due

    def _now_ms(self) -> int:
        if self._clock:
            return self._clock()
        seconds, micros = self._redis.time()
        return int(seconds) * 1000 + int(micros) // 1000

    def _jobs(self, job_ids: Sequence[str]) -> Iterator[Job]:
        for job_id in job_ids:
            if job := Job.read(self._redis.hgetall(keys.JOB + job_id)):
                yield job
