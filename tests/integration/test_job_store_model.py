"""The job store on a real Redis does, step by step, what its model in memory (job_model.py) does."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from job_model import ENDED, HELD, JobModel, ModelJob
from judgement import JUDGEMENT
from redis import Redis

from refine_jobs import keys
from refine_jobs.blobs import Blob
from refine_jobs.edge_store import JobStore
from refine_jobs.record import Job, Submission, Task
from refine_jobs.redis_server import connect_async
from refine_jobs.settings import JobSettings
from refine_jobs.share import Share
from refine_jobs.worker_store import LeaseLost, WorkerStore
from refine_proto.errors import Conflict, IdempotencyKeyReused, MeshInvalid, WorkerLost
from refine_proto.models import Event, Priority, Progress, RefinementOptions, RefinementSpec, State

if TYPE_CHECKING:
    from .conftest import HandClock

T = TypeVar("T")
SPEC = RefinementSpec.model_validate(
    {"camera": {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.9}}
)
HALF = Progress(iteration=1, total=2, percent=50.0)
SMALL = JobSettings(lease_s=15, retention_s=100, max_attempts=2, max_queued=5, max_queued_per_owner=4)
RQ_QUEUE = "rq:queue:refine-default"
OWNERS = st.sampled_from(["ann", "ann", "bob"])
SECONDS = st.sampled_from([1, 14, 15, 30, 100])  # on both sides of lease_s, MISSING_S and retention_s
PICK = st.integers(0, 3)  # which job: those that are kept first; which claim: the newest first


@dataclass
class Watcher:
    """What a watcher of a job has got."""

    job: ModelJob
    after: int
    got: list[Event]
    task: asyncio.Task[None]


some_job = precondition(lambda machine: machine.model.jobs)
some_claim = precondition(lambda machine: machine.claims)
some_delivery = precondition(lambda machine: machine.model.deliveries)


class JobStoreMachine(RuleBasedStateMachine):
    """Every rule does one thing to both and compares the answers; the invariants compare all that is kept."""

    def __init__(self, redis: Redis, url: str, clock: HandClock) -> None:
        super().__init__()
        redis.flushall()
        self.redis: Any = redis
        self.clock = clock
        self.model = JobModel(SMALL)
        self.worker = WorkerStore(redis, SMALL, clock)
        self.runner = asyncio.Runner()
        self.edge = self.run(self.open(url))
        self.claims: list[Job] = []
        self.watchers: list[Watcher] = []

    async def open(self, url: str) -> JobStore:
        return JobStore(connect_async(url), SMALL, self.clock)

    def teardown(self) -> None:
        try:
            for watcher in self.watchers:
                self.run(self.has_got_everything(watcher))
        finally:
            self.run(self.edge.close())
            self.runner.close()

    # ---- the edge ----

    @rule(
        owner=OWNERS,
        key=st.sampled_from([None, None, "k"]),
        content=st.sampled_from("xxy"),
        task=st.sampled_from([Task.REFINE, Task.REFINE, Task.VALIDATE]),
        priority=st.sampled_from(Priority),
        iterations=st.sampled_from([1, 100, 5_000]),
    )
    def submit(
        self, owner: str, key: str | None, content: str, task: Task, priority: Priority, iterations: int
    ) -> None:
        if no_room := self.model.no_room(owner):
            with pytest.raises(no_room):
                self.run(self.edge.begin_upload(owner))
            return
        upload = self.run(self.edge.begin_upload(owner))
        blob = Blob(1, content)
        options = RefinementOptions(priority=priority, iterations=iterations)
        submission = Submission(
            id=upload,
            owner=owner,
            spec=SPEC.model_copy(update={"options": options}),
            task=task,
            mesh=blob,
            silhouette=blob,
            idempotency_key=key,
        )
        content += f" {priority} {iterations}"
        job = self.model.submit(upload, owner, key, content, Share.of(submission))
        if job.content != content:
            with pytest.raises(IdempotencyKeyReused, match=job.id):
                self.run(self.edge.submit(submission))
        else:
            submitted = self.run(self.edge.submit(submission))
            assert (submitted.refinement.id, submitted.replayed) == (job.id, job.id != upload)

    @rule(owner=OWNERS)
    def drop_an_upload(self, owner: str) -> None:
        if not self.model.no_room(owner):
            upload = self.run(self.edge.begin_upload(owner))
            self.run(self.edge.discard_upload(upload))
            self.model.trash.add(upload)

    @some_job
    @rule(pick=PICK, owner=OWNERS)
    def cancel(self, pick: int, owner: str) -> None:
        job = self.job(pick)
        if not self.is_refused(job, owner, self.edge.cancel):
            self.model.cancel(job)
            assert self.run(self.edge.cancel(owner, job.id)).state is job.state

    @some_job
    @rule(pick=PICK, owner=OWNERS)
    def delete(self, pick: int, owner: str) -> None:
        job = self.job(pick)
        if self.is_refused(job, owner, self.edge.delete):
            return
        if job.state in HELD:
            with pytest.raises(Conflict):
                self.run(self.edge.delete(owner, job.id))
        else:
            self.run(self.edge.delete(owner, job.id))
            self.model.delete(job)

    @some_job
    @rule(pick=PICK, share=st.floats(0, 0.99))
    def watch(self, pick: int, share: float) -> None:
        """From after an event that has been; with the next one the watcher has joined."""
        job = self.job(pick)
        after = int(share * len(job.events))

        async def join(owner: str, job_id: str) -> Watcher:
            steps = self.edge.watch(owner, job_id, after)
            got = [await anext(steps)]

            async def collect() -> None:
                async for event in steps:
                    got.append(event)

            return Watcher(job, after, got, asyncio.create_task(collect()))

        if not self.is_refused(job, job.owner, join):
            self.watchers.append(self.run(join(job.owner, job.id)))

    # ---- a slot ----

    @some_delivery
    @rule()
    def take(self) -> None:
        """What RQ does: the first delivery goes to a slot."""
        self.claim(self.model.jobs[self.first_delivery().rpartition("-")[0]])

    @some_delivery
    @rule()
    def lose_a_delivery(self) -> None:
        """A slot takes it and dies before it claims the job."""
        self.first_delivery()

    @some_job
    @rule(pick=PICK)
    def take_without_a_delivery(self, pick: int) -> None:
        """RQ may deliver twice."""
        self.claim(self.job(pick))

    @some_claim
    @rule(pick=PICK, reports=st.booleans())
    def renew(self, pick: int, reports: bool) -> None:
        claim, job = self.a_claim(pick)
        write = partial(self.worker.report, claim, HALF) if reports else partial(self.worker.renew, claim)
        if not self.is_lost(claim, write):
            assert write() is job.state
            self.model.renew(job)
            if reports:
                job.tell("progress")

    @some_claim
    @rule(pick=PICK, state=st.sampled_from(ENDED))
    def finish(self, pick: int, state: State) -> None:
        claim, job = self.a_claim(pick)
        write = {
            State.SUCCEEDED: partial(self.worker.finish, claim, [], JUDGEMENT),
            State.FAILED: partial(self.worker.fail, claim, MeshInvalid("expected triangles, got none")),
            State.CANCELLED: partial(self.worker.cancelled, claim),
        }[state]
        if not self.is_lost(claim, write):
            write()
            self.model.end(job, state)

    @some_claim
    @rule(pick=PICK)
    def give_back(self, pick: int) -> None:
        claim, job = self.a_claim(pick)
        write = partial(self.worker.give_back, claim, "the worker shuts down")
        if not self.is_lost(claim, write):
            self.model.give_back(job)
            assert write() is job.state

    @some_claim
    @rule(pick=PICK)
    def lose(self, pick: int) -> None:
        claim, job = self.a_claim(pick)
        write = partial(self.worker.lose, claim, WorkerLost("the engine process was killed"))
        if not self.is_lost(claim, write):
            job.lost += 1
            self.model.give_back(job)
            assert write() is job.state

    # ---- time, and a round of the reaper ----

    @rule(seconds=SECONDS)
    def time_passes(self, seconds: int) -> None:
        self.model.now_s += seconds
        self.clock.move(seconds)

    @rule(seconds=SECONDS)
    def reap(self, seconds: int) -> None:
        self.time_passes(seconds)
        assert self.worker.take_back_lost() == self.model.take_back_lost()
        assert self.worker.requeue_missing() == self.model.requeue_missing()
        assert set(self.worker.expire()) == self.model.expire()
        assert self.worker.trash() == self.model.trash
        for job_id in self.model.trash:
            self.worker.trash_deleted(job_id)
        self.model.trash.clear()

    # ---- what must hold after every step ----

    @invariant()
    def records_agree(self) -> None:
        ahead = {job.id: n for n, job in enumerate(self.model.queue())}
        for job in self.model.jobs.values():
            if not self.is_refused(job, job.owner, self.edge.get):
                shown = self.run(self.edge.get(job.owner, job.id))
                assert (shown.state, shown.attempt) == (job.state, job.attempt)
                assert shown.queue_position == ahead.get(job.id)

    @invariant()
    def lists_agree(self) -> None:
        for owner in ("ann", "bob"):
            page = self.run(self.edge.list(owner, limit=100))
            mine = [job.id for job in self.model.kept() if job.owner == owner and not job.is_question]
            assert [shown.id for shown in page.refinements] == mine[::-1]

    @invariant()
    def indices_agree(self) -> None:
        owners = [job.owner for job in self.model.kept() if job.queued]
        counts = {owner: str(owners.count(owner)) for owner in set(owners)}
        assert self.redis.hgetall(keys.QUEUED_BY_OWNER) == counts
        assert self.ids(keys.LEASES) == {job.id for job in self.model.kept() if job.state in HELD}
        assert self.ids(keys.EXPIRY) == {job.id for job in self.model.kept() if job.state in ENDED}
        assert self.ids(keys.UPLOADS) == set()
        queued = [job for job in self.model.kept() if job.queued]
        for flow in {job.share.flow for job in self.model.jobs.values()}:
            assert self.ids(keys.FLOW + flow) == {job.id for job in queued if job.share.flow == flow}
        cost_ms = sum(job.share.cost_ms for job in queued)
        assert int(self.redis.get(keys.QUEUED_COST) or 0) == cost_ms
        assert self.worker.trash() == self.model.trash
        assert self.redis.lrange(RQ_QUEUE, 0, -1) == self.model.deliveries

    # ---- helpers ----

    def run(self, step: Awaitable[T]) -> T:
        async def bounded() -> T:
            return await asyncio.wait_for(step, 20)

        return self.runner.run(bounded())

    def ids(self, key: str) -> set[str]:
        return set(self.redis.zrange(key, 0, -1))

    def job(self, pick: int) -> ModelJob:
        jobs = sorted(self.model.jobs.values(), key=lambda job: (not job.kept, -job.number))
        return jobs[pick % len(jobs)]

    def a_claim(self, pick: int) -> tuple[Job, ModelJob]:
        claim = self.claims[pick % len(self.claims)]
        return claim, self.model.jobs[claim.id]

    def first_delivery(self) -> str:
        delivery = self.model.deliveries.pop(0)
        assert self.redis.lpop(RQ_QUEUE) == delivery
        return delivery

    def claim(self, job: ModelJob) -> None:
        claim = self.worker.claim(job.id, "slot-0")
        assert (claim is not None) == self.model.claim(job)
        if claim is not None:
            assert (claim.id, claim.attempt, claim.state) == (job.id, job.attempt, State.RUNNING)
            self.claims.insert(0, claim)

    def is_refused(self, job: ModelJob, owner: str, call: Callable[[str, str], Awaitable[object]]) -> bool:
        """Whether this owner cannot see the job; then the call must say so."""
        refusal = self.model.refusal(job, owner)
        if refusal:
            with pytest.raises(refusal):
                self.run(call(owner, job.id))
        return refusal is not None

    def is_lost(self, claim: Job, write: Callable[[], object]) -> bool:
        """Whether the claim no longer holds its job; then the write must say so."""
        if self.model.jobs[claim.id].holds(claim.attempt):
            return False
        with pytest.raises(LeaseLost):
            write()
        return True

    async def has_got_everything(self, watcher: Watcher) -> None:
        """Every event once and in order, and the end if there was one."""
        wanted = list(enumerate(watcher.job.events, start=1))[watcher.after :]
        if watcher.job.events[-1][0] == "completed":
            await watcher.task
        while len(watcher.got) < len(wanted):
            await asyncio.sleep(0.001)
        watcher.task.cancel()
        told = [(event.sequence, (event.type.value, event.state)) for event in watcher.got]
        assert told == wanted


def test_the_store_does_what_the_model_does(redis: Redis, redis_url: str, clock: HandClock) -> None:
    run_state_machine_as_test(
        partial(JobStoreMachine, redis, redis_url, clock),  # type: ignore[arg-type]
        settings=settings(
            max_examples=40,
            stateful_step_count=50,
            deadline=None,
            database=None,
            suppress_health_check=[HealthCheck.too_slow],
        ),
    )
