"""The life of a job on a real Redis, from both sides."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

import pytest
from judgement import JUDGEMENT

from refine_jobs import edge_store, keys
from refine_jobs.edge_store import JobStore
from refine_jobs.reaper import reap
from refine_jobs.scripts import Scripts
from refine_jobs.worker_store import LeaseLost
from refine_proto.errors import (
    Conflict,
    Expired,
    IdempotencyKeyReused,
    InvalidInput,
    MeshInvalid,
    NotFound,
    OptionsInvalid,
    OutOfMemory,
    QueueFull,
    QuotaExceeded,
)
from refine_proto.lists import RefinementFilter
from refine_proto.models import Artifact, Event, Progress, RefinementSpec, State

if TYPE_CHECKING:
    from .conftest import HandClock, Jobs

HALF = Progress(iteration=1, total=2, percent=50.0, losses={"total": 1.0})


async def watched(store: JobStore, job_id: str, after: int = 0, owner: str = "ann") -> list[Event]:
    return [event async for event in store.watch(owner, job_id, after)]


def test_a_job_from_submit_to_success(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            submitted = (await jobs.submit(store)).refinement
            assert (submitted.state, submitted.queue_position, submitted.attempt) == (State.QUEUED, 0, 0)
            assert submitted.options.timeout_s == jobs.settings.job_timeout_s

            job = jobs.worker.claim(submitted.id, "slot-0")
            assert job is not None
            assert (job.attempt, job.request_id) == (1, "req-1")
            assert job.traceparent == "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
            assert jobs.blobs.get(keys.input_blob(job.id, keys.MESH)).startswith(b"mesh")

            assert jobs.worker.report(job, HALF) is State.RUNNING
            running = await store.get("ann", job.id)
            assert (running.state, running.progress, running.queue_position) == (State.RUNNING, HALF, None)

            artifact = Artifact(name="refined.glb", media_type="model/gltf-binary", size_bytes=3, sha256="ab")
            jobs.worker.finish(job, [artifact], JUDGEMENT)
            done = await store.get("ann", job.id)
            assert (done.state, done.artifacts) == (State.SUCCEEDED, [artifact])
            assert {name: getattr(done, name) for name in type(JUDGEMENT).model_fields} == dict(JUDGEMENT)
            assert done.finished_at
            assert done.started_at
            assert done.created_at <= done.started_at <= done.finished_at < done.expires_at

    asyncio.run(scenario())


def test_the_input_fails_a_job_with_its_reason(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            job = jobs.worker.claim(job_id, "slot-0")
            assert job
            jobs.worker.fail(job, MeshInvalid("expected triangles, got none"))
            failed = await store.get("ann", job_id)
            assert failed.state is State.FAILED
            assert failed.error
            assert (failed.error.reason, failed.error.request_id) == ("MESH_INVALID", "req-1")

    asyncio.run(scenario())


def test_a_terminal_state_is_written_once(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            jobs.worker.finish(job, [], JUDGEMENT)
            before = await store.get("ann", job.id)
            writes: list[tuple[Any, ...]] = [
                (jobs.worker.fail, job, MeshInvalid("late")),
                (jobs.worker.cancelled, job),
                (jobs.worker.finish, job, [], JUDGEMENT),
                (jobs.worker.report, job, HALF),
                (jobs.worker.renew, job),
                (jobs.worker.give_back, job, "late"),
            ]
            for write, *args in writes:
                with pytest.raises(LeaseLost):
                    write(*args)
            assert await store.cancel("ann", job.id) == before
            assert await store.get("ann", job.id) == before
            assert jobs.worker.claim(job.id, "slot-1") is None

    asyncio.run(scenario())


def test_one_key_from_many_threads_makes_one_job(jobs: Jobs) -> None:
    answers: list[tuple[str, bool]] = []
    barrier = threading.Barrier(16)

    def client() -> None:
        async def post() -> None:
            async with jobs.edge() as store:
                barrier.wait(30)
                submitted = await jobs.submit(store, key="order-66", content=b"same")
                answers.append((submitted.refinement.id, submitted.replayed))

        asyncio.run(post())

    threads = [threading.Thread(target=client) for _ in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(answers) == 16
    assert len({job_id for job_id, _ in answers}) == 1
    assert [replayed for _, replayed in answers].count(False) == 1
    assert jobs.redis.llen("rq:queue:refine-default") == 1
    reap(jobs.worker, jobs.blobs)  # takes away the blobs of the other fifteen uploads
    assert jobs.blobs.delete_folder("jobs") == 2


def test_a_key_belongs_to_its_content_and_its_owner(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            first = await jobs.submit(store, key="k", content=b"one")
            with pytest.raises(IdempotencyKeyReused, match=first.refinement.id):
                await jobs.submit(store, key="k", content=b"two")
            other = await jobs.submit(store, owner="bob", key="k", content=b"two")
            assert other.refinement.id != first.refinement.id
            await store.delete("ann", first.refinement.id)
            again = await jobs.submit(store, key="k", content=b"one")
            assert not again.replayed

    asyncio.run(scenario())


def test_cancel_queued(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            assert (await store.cancel("ann", job_id)).state is State.CANCELLED
            assert jobs.worker.claim(job_id, "slot-0") is None
            assert jobs.redis.llen("rq:queue:refine-default") == 0
            assert not jobs.redis.exists(f"rq:job:{job_id}-1")
            assert (await watched(store, job_id))[-1].state is State.CANCELLED

    asyncio.run(scenario())


def test_cancel_running(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            assert (await store.cancel("ann", job.id)).state is State.CANCELLING
            assert (await store.cancel("ann", job.id)).state is State.CANCELLING
            assert jobs.worker.renew(job) is State.CANCELLING
            with pytest.raises(Conflict):
                await store.delete("ann", job.id)
            jobs.worker.cancelled(job)
            assert (await store.get("ann", job.id)).state is State.CANCELLED

    asyncio.run(scenario())


def test_a_lost_worker_is_replaced_until_the_last_attempt(jobs: Jobs) -> None:
    jobs = jobs.with_settings(max_attempts=2)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            other_id = (await jobs.submit(store)).refinement.id
            first = jobs.worker.claim(job_id, "slot-0")
            assert first
            assert reap(jobs.worker, jobs.blobs).taken_back == ()  # the lease holds

            jobs.end_lease(job_id)
            assert reap(jobs.worker, jobs.blobs).taken_back == ((job_id, State.QUEUED),)
            again = await store.get("ann", job_id)
            assert (again.state, again.queue_position) == (State.QUEUED, 0)  # before the other one
            assert (await store.get("ann", other_id)).queue_position == 1

            second = jobs.worker.claim(job_id, "slot-1")
            assert second
            assert second.attempt == 2
            with pytest.raises(LeaseLost):  # the first worker wakes up
                jobs.worker.finish(first, [], JUDGEMENT)
            jobs.end_lease(job_id)
            assert reap(jobs.worker, jobs.blobs).taken_back == ((job_id, State.FAILED),)
            failed = await store.get("ann", job_id)
            assert failed.error
            assert failed.error.reason == "WORKER_LOST"
            assert "slot-1" in failed.error.detail

    asyncio.run(scenario())


def test_a_job_that_was_to_stop_when_its_worker_died_is_cancelled(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            await store.cancel("ann", job.id)
            jobs.end_lease(job.id)
            reap(jobs.worker, jobs.blobs)
            assert (await store.get("ann", job.id)).state is State.CANCELLED

    asyncio.run(scenario())


def test_a_record_that_cannot_be_read_stops_neither_the_reaper_nor_a_list(jobs: Jobs) -> None:
    """A newer version may write what this one does not know."""

    async def scenario() -> None:
        async with jobs.edge() as store:
            strange, lost = [(await jobs.submit(store)).refinement.id for _ in range(2)]
            for job_id in (strange, lost):
                assert jobs.worker.claim(job_id, "slot-0")
            jobs.redis.hset(keys.JOB + strange, "progress", "{}")
            jobs.redis.zadd(keys.LEASES, {strange: 1, lost: 2})
            assert reap(jobs.worker, jobs.blobs).taken_back == ((lost, State.QUEUED),)
            assert [shown.id for shown in (await store.list("ann")).refinements] == [lost]

    asyncio.run(scenario())


def test_a_renewed_lease_holds(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            jobs.end_lease(job.id)
            jobs.worker.renew(job)
            assert reap(jobs.worker, jobs.blobs).taken_back == ()

    asyncio.run(scenario())


def test_a_job_that_rq_forgot_is_enqueued_again(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            assert reap(jobs.worker, jobs.blobs).requeued == ()
            jobs.redis.delete("rq:queue:refine-default", f"rq:job:{job_id}-1")
            assert reap(jobs.worker, jobs.blobs).requeued == ()  # first sight: a worker may just be taking it
            jobs.redis.hset(keys.MISSING, job_id, "1")
            assert reap(jobs.worker, jobs.blobs).requeued == (job_id,)
            assert jobs.redis.lrange("rq:queue:refine-default", 0, -1) == [f"{job_id}-1"]
            assert (await store.get("ann", job_id)).queue_position == 0

    asyncio.run(scenario())


def test_jobs_stay_in_their_pool_whoever_reaps_or_cancels_them(jobs: Jobs) -> None:
    other = jobs.with_settings(pool="other")

    def listed(pool: str) -> list[str]:
        return jobs.redis.lrange(f"rq:queue:refine-{pool}", 0, -1)  # type: ignore[return-value]

    async def scenario() -> None:
        async with jobs.edge() as store:
            lost, waiting = [(await jobs.submit(store)).refinement.id for _ in range(2)]
        assert jobs.worker.claim(lost, "slot-0")
        jobs.redis.lrem("rq:queue:refine-default", 0, f"{lost}-1")  # as RQ's worker does
        jobs.end_lease(lost)
        jobs.redis.hset(keys.MISSING, waiting, "1")
        reaped = reap(other.worker, jobs.blobs)
        assert (reaped.taken_back, reaped.requeued) == (((lost, State.QUEUED),), ())
        assert (listed("default"), listed("other")) == ([f"{lost}-2", f"{waiting}-1"], [])
        async with other.edge() as store:
            await store.cancel("ann", waiting)
        assert listed("default") == [f"{lost}-2"]

    asyncio.run(scenario())


def test_given_back_jobs_run_elsewhere_and_lose_nothing(jobs: Jobs) -> None:
    """Only a slot that was lost counts against the attempts of a job."""
    jobs = jobs.with_settings(max_attempts=2)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            for attempt in range(1, 5):
                job = jobs.worker.claim(job_id, "slot-0")
                assert job
                assert job.attempt == attempt
                assert jobs.worker.give_back(job, "the worker shuts down") is State.QUEUED
            for state in (State.QUEUED, State.FAILED):
                assert jobs.worker.claim(job_id, "slot-0")
                jobs.end_lease(job_id)
                assert reap(jobs.worker, jobs.blobs).taken_back == ((job_id, state),)

    asyncio.run(scenario())


def test_a_job_that_loses_its_attempts_fails_with_what_ended_the_last(jobs: Jobs) -> None:
    jobs = jobs.with_settings(max_attempts=2)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            for state in (State.QUEUED, State.FAILED):
                job = jobs.worker.claim(job_id, "slot-0")
                assert job
                assert jobs.worker.lose(job, OutOfMemory("the engine process was killed")) is state
            failed = await store.get("ann", job_id)
            assert failed.error
            assert failed.error.reason == "OUT_OF_MEMORY"
            assert failed.error.detail.endswith("killed; that was the last of 2 attempts that it may lose")
            counters = jobs.redis.hgetall(keys.METRICS)
            assert (counters["requeued:lost"], counters["jobs:failed:OUT_OF_MEMORY"]) == ("1", "1")

    asyncio.run(scenario())


DAY_S = 86_400  # JobSettings.retention_s


def test_expiry_leaves_a_tombstone_and_no_bytes(jobs: Jobs, clock: HandClock) -> None:
    jobs = jobs.with_clock(clock)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            jobs.blobs.put(keys.artifact_blob(job.id, 1, "refined.glb"), b"glb")
            jobs.worker.finish(job, [], JUDGEMENT)
            clock.move(DAY_S - 1)
            assert reap(jobs.worker, jobs.blobs).expired == ()
            clock.move(1)
            reaped = reap(jobs.worker, jobs.blobs)
            assert (reaped.expired, reaped.blobs_deleted) == ((job.id,), 3)
            with pytest.raises(Expired):
                await store.get("ann", job.id)
            with pytest.raises(NotFound):
                await store.get("bob", job.id)
            assert (await store.list("ann")).refinements == []
            assert 0 < jobs.redis.pttl(keys.JOB + job.id) <= jobs.settings.tombstone_s * 1000
            assert 0 < jobs.redis.ttl(keys.EVENTS + job.id) <= keys.LAST_WORDS_S
            assert jobs.worker.claim(job.id, "slot-0") is None

    asyncio.run(scenario())


def test_a_job_that_waits_or_runs_does_not_expire(jobs: Jobs, clock: HandClock) -> None:
    """Its lifetime counts from its end, however long it waits, runs, is given back and waits again."""
    jobs = jobs.with_clock(clock)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id

            def day_passes() -> None:
                clock.move(DAY_S + 1)
                assert jobs.worker.expire() == []

            day_passes()
            assert (await store.get("ann", job_id)).state is State.QUEUED
            job = jobs.worker.claim(job_id, "slot-0")
            assert job
            day_passes()
            jobs.worker.give_back(job, "the worker shuts down")
            day_passes()
            again = jobs.worker.claim(job_id, "slot-0")
            assert again
            clock.move(DAY_S)
            jobs.worker.finish(again, [], JUDGEMENT)
            done = await store.get("ann", job_id)
            assert done.finished_at
            assert (done.expires_at - done.finished_at).total_seconds() == DAY_S
            clock.move(DAY_S - 1)
            assert jobs.worker.expire() == []
            clock.move(1)
            assert jobs.worker.expire() == [job_id]

    asyncio.run(scenario())


def test_a_job_that_ends_while_it_is_about_to_expire_does_not_stay_for_ever(
    jobs: Jobs, clock: HandClock
) -> None:
    """A reaper saw it due, for instance as version 0.1.0 queued it, and comes when it has just ended."""
    jobs = jobs.with_clock(clock)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            await store.cancel("ann", job_id)
            jobs.redis.zadd(keys.EXPIRY, {job_id: 1})
            assert jobs.worker.expire() == []
            clock.move(DAY_S)
            assert jobs.worker.expire() == [job_id]

    asyncio.run(scenario())


def test_queued_jobs_that_version_0_1_0_let_expire_are_kept(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            jobs.redis.hset(keys.JOB + job_id, "expires_ms", "1")
            jobs.redis.zadd(keys.EXPIRY, {job_id: 1})
            assert jobs.worker.expire() == []
            assert not jobs.redis.exists(keys.EXPIRY)
            assert (await store.get("ann", job_id)).state is State.QUEUED

    asyncio.run(scenario())


def test_an_upload_that_never_became_a_job_is_removed(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            stale, fresh, dropped = [await store.begin_upload("ann") for _ in range(3)]
            for job_id in (stale, fresh, dropped):
                jobs.blobs.put(keys.input_blob(job_id, keys.MESH), b"mesh")
            jobs.redis.zadd(keys.UPLOADS, {stale: 1})
            await store.discard_upload(dropped)
            assert reap(jobs.worker, jobs.blobs).blobs_deleted == 2
            assert jobs.blobs.get(keys.input_blob(fresh, keys.MESH)) == b"mesh"

    asyncio.run(scenario())


def test_delete_removes_everything(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            await store.delete("ann", job_id)
            for call in (store.get, store.cancel, store.delete):
                with pytest.raises(NotFound):
                    await call("ann", job_id)
            assert reap(jobs.worker, jobs.blobs).blobs_deleted == 2
            left = {key for key in jobs.redis.scan_iter() if job_id in key}
            assert left == {keys.EVENTS + job_id}  # the last word for whoever was watching
            assert 0 < jobs.redis.ttl(keys.EVENTS + job_id) <= 60

    asyncio.run(scenario())


def test_of_many_deletions_at_once_one_does_it(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            await asyncio.gather(*(store.get("ann", job_id) for _ in range(20)))  # opens the connections
            calls = (store.delete("ann", job_id) for _ in range(20))
            results = await asyncio.gather(*calls, return_exceptions=True)
            assert [result for result in results if not isinstance(result, NotFound)] == [None]
            assert jobs.redis.smembers(keys.TRASH) == {job_id}

    asyncio.run(scenario())


def test_a_deletion_that_meets_the_reaper_leaves_the_tombstone(jobs: Jobs, clock: HandClock) -> None:
    jobs = jobs.with_clock(clock)

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            await store.cancel("ann", job_id)
            clock.move(DAY_S)
            assert jobs.worker.expire() == [job_id]
            assert Scripts(jobs.redis).run("delete", job_id) == "gone"
            with pytest.raises(Expired):
                await store.delete("ann", job_id)

    asyncio.run(scenario())


def test_a_page_of_a_rare_kind_is_short_and_the_next_goes_on(
    jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(edge_store, "_LOOK", 3)
    monkeypatch.setattr(edge_store, "_MOST_LOOKS", 2)
    wanted = RefinementFilter.model_validate({"state": "cancelled"})

    async def check() -> None:
        async with jobs.edge() as store:
            ids = [(await jobs.submit(store)).refinement.id for _ in range(14)]
            for rare in (ids[0], ids[1], ids[9]):
                await store.cancel("ann", rare)
            pages: list[list[str]] = []
            cursor = None
            while not pages or cursor:
                page = await store.list("ann", 2, cursor, wanted)
                pages.append([item.id for item in page.refinements])
                cursor = page.next_cursor
            assert pages == [[ids[9]], [], [ids[1], ids[0]]]

    asyncio.run(check())


def test_lists_page_newest_first_and_show_only_the_owners(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            mine = [(await jobs.submit(store)).refinement.id for _ in range(5)]
            theirs = (await jobs.submit(store, owner="bob")).refinement.id
            seen, cursor = [], None
            sizes = []
            while True:
                page = await store.list("ann", 2, cursor)
                sizes.append(len(page.refinements))
                seen += [r.id for r in page.refinements]
                if cursor is None:
                    await jobs.submit(store)  # a newer one does not disturb the pages
                cursor = page.next_cursor
                if cursor is None:
                    break
            assert seen == mine[::-1]
            assert sizes == [2, 2, 1]
            with pytest.raises(InvalidInput, match="next_cursor"):
                await store.list("ann", 2, "not a cursor")
            for call in (store.get, store.cancel, store.delete):
                with pytest.raises(NotFound):
                    await call("ann", theirs)
            with pytest.raises(NotFound):
                await watched(store, theirs)

    asyncio.run(scenario())


def test_bounds_of_the_queue(jobs: Jobs) -> None:
    jobs = jobs.with_settings(max_queued=3, max_queued_per_owner=2)

    async def scenario() -> None:
        async with jobs.edge() as store:
            late = await store.begin_upload("ann")  # let in, but the room is gone when it is submitted
            first = (await jobs.submit(store)).refinement.id
            await jobs.submit(store)
            with pytest.raises(QuotaExceeded) as quota:
                await store.begin_upload("ann")
            assert quota.value.retry_after_s
            await jobs.submit(store, owner="bob")
            with pytest.raises(QueueFull):
                await store.begin_upload("cid")
            assert jobs.worker.claim(first, "slot-0")  # one starts: room for one
            await jobs.submit(store)
            assert late
            counts = jobs.redis.hgetall(keys.QUEUED_BY_OWNER)
            assert counts == {"ann": "2", "bob": "1"}

    asyncio.run(scenario())


def test_bounds_hold_against_a_crowd(jobs: Jobs) -> None:
    jobs = jobs.with_settings(max_queued_per_owner=5)

    async def scenario() -> None:
        async with jobs.edge() as store:
            results = await asyncio.gather(*(jobs.submit(store) for _ in range(20)), return_exceptions=True)
            assert sum(isinstance(result, QuotaExceeded) for result in results) == 15
            assert jobs.redis.zcard(keys.QUEUED) == 5

    asyncio.run(scenario())


def test_a_timeout_beyond_the_servers_is_refused(jobs: Jobs) -> None:
    spec = RefinementSpec.model_validate(
        {
            "camera": {"type": "look_at", "azimuth_degrees": 0, "elevation_degrees": 0, "distance": 2},
            "options": {"timeout_s": 1e6},
        }
    )

    async def scenario() -> None:
        async with jobs.edge() as store:
            with pytest.raises(OptionsInvalid, match="at most 3600"):
                await jobs.submit(store, spec=spec)

    asyncio.run(scenario())
