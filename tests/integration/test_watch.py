"""Watching jobs: replay, live events, many watchers."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import TYPE_CHECKING, Any

import pytest
from judgement import JUDGEMENT

from refine_jobs import keys
from refine_jobs.edge_store import JobStore
from refine_jobs.scripts import Scripts
from refine_proto.models import Event, EventType, Progress, State

if TYPE_CHECKING:
    from .conftest import Jobs


def progress(iteration: int) -> Progress:
    return Progress(iteration=iteration, total=10, percent=10.0 * iteration)


async def watched(store: JobStore, job_id: str, after: int = 0) -> list[Event]:
    return [event async for event in store.watch("ann", job_id, after)]


def run(scenario: Coroutine[None, None, None]) -> None:
    """A watcher that waits in vain is an error."""
    asyncio.run(asyncio.wait_for(scenario, 60))


async def joined(store: JobStore, job_id: str) -> asyncio.Task[list[int]]:
    """The sequences that a watcher gets, of a watcher that has had its first event."""
    steps = store.watch("ann", job_id)
    first = await anext(steps)

    async def collect() -> list[int]:
        return [first.sequence, *[event.sequence async for event in steps]]

    return asyncio.create_task(collect())


def finish(jobs: Jobs, job_id: str) -> None:
    """Events 2 to 4 of a queued job."""
    job = jobs.worker.claim(job_id, "slot-0")
    assert job
    jobs.worker.report(job, progress(1))
    jobs.worker.finish(job, [], JUDGEMENT)


def test_replay_from_a_sequence(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            for i in (1, 2):
                jobs.worker.report(job, progress(i))
            jobs.worker.finish(job, [], JUDGEMENT)
            events = await watched(store, job.id)
            assert [(e.sequence, e.type.value, e.state.value) for e in events] == [
                (1, "state", "queued"),
                (2, "state", "running"),
                (3, "progress", "running"),
                (4, "progress", "running"),
                (5, "completed", "succeeded"),
            ]
            assert events[3].progress == progress(2)
            assert events[-1].refinement == await store.get("ann", job.id)
            assert await watched(store, job.id, 3) == events[3:]
            assert await watched(store, job.id, 5) == []  # nothing will follow

    run(scenario())


def test_events_arrive_while_watching(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            steps = store.watch("ann", job_id)
            assert (await anext(steps)).state is State.QUEUED
            job = jobs.worker.claim(job_id, "slot-0")
            assert job
            assert (await asyncio.wait_for(anext(steps), 10)).state is State.RUNNING
            await store.cancel("ann", job_id)
            assert (await asyncio.wait_for(anext(steps), 10)).state is State.CANCELLING
            jobs.worker.cancelled(job)
            last = await asyncio.wait_for(anext(steps), 10)
            assert (last.type, last.state) == (EventType.COMPLETED, State.CANCELLED)
            assert [event async for event in steps] == []

    run(scenario())


def test_watchers_of_a_deleted_job_are_told(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            steps = store.watch("ann", job_id)
            await anext(steps)
            await store.delete("ann", job_id)
            last = await asyncio.wait_for(anext(steps), 10)
            assert (last.type, last.state, last.refinement) == (EventType.COMPLETED, State.EXPIRED, None)
            assert [event async for event in steps] == []

    run(scenario())


def test_watchers_of_a_job_that_is_deleted_as_soon_as_it_has_ended_hear_of_its_end(jobs: Jobs) -> None:
    """Whoever watches through another service may delete it before this one has read the end."""

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            task = await joined(store, job_id)
            finish(jobs, job_id)
            assert Scripts(jobs.redis).run("delete", job_id) == "deleted"
            assert await asyncio.wait_for(task, 10) == [1, 2, 3, 4]

    run(scenario())


def test_hundreds_of_watchers_share_few_connections(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            ids = [(await jobs.submit(store)).refinement.id for _ in range(5)]
            tasks = await asyncio.gather(*(joined(store, ids[i % 5]) for i in range(300)))
            connections = int(jobs.redis.info("clients")["connected_clients"])
            assert connections < 40
            for job_id in ids:
                finish(jobs, job_id)
            histories = await asyncio.wait_for(asyncio.gather(*tasks), 30)
            assert {tuple(history) for history in histories} == {(1, 2, 3, 4)}

    run(scenario())


def test_a_feed_that_loses_its_connection_misses_nothing(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            task = await joined(store, job_id)
            while not jobs.redis.client_kill_filter(_type="pubsub"):
                await asyncio.sleep(0.01)  # it does not listen yet
            finish(jobs, job_id)
            assert await asyncio.wait_for(task, 20) == [1, 2, 3, 4]

    run(scenario())


def test_a_watcher_that_joins_takes_nothing_from_another(jobs: Jobs) -> None:
    """It may read an event before the ring of that event has reached the reader."""

    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            steps = store.watch("ann", job.id)
            assert [(await anext(steps)).sequence for _ in range(2)] == [1, 2]
            jobs.worker.report(job, progress(1))
            assert (await asyncio.wait_for(anext(steps), 10)).sequence == 3  # from the reader
            jobs.redis.xadd(
                keys.EVENTS + job.id, {"type": "completed", "state": "succeeded", "time": 1}, "4-0"
            )
            assert [event.sequence for event in await watched(store, job.id)] == [1, 2, 3, 4]
            jobs.redis.publish(keys.DOORBELL, job.id)
            assert (await asyncio.wait_for(anext(steps), 10)).sequence == 4
            assert [event async for event in steps] == []

    run(scenario())


def test_watchers_that_join_while_their_job_ends_miss_nothing(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            ids = [(await jobs.submit(store)).refinement.id for _ in range(30)]
            tasks = await asyncio.gather(*(joined(store, job_id) for job_id in ids))

            async def join(job_id: str) -> None:
                for _ in range(4):
                    tasks.append(await joined(store, job_id))

            ends = (asyncio.to_thread(finish, jobs, job_id) for job_id in ids)
            await asyncio.gather(*ends, *(join(job_id) for job_id in ids))
            histories = await asyncio.wait_for(asyncio.gather(*tasks), 30)
            assert {tuple(history) for history in histories} == {(1, 2, 3, 4)}

    run(scenario())


STRANGE: list[dict[Any, Any]] = [
    {"type": "resized", "state": "running", "time": 1},  # of a newer version
    {"type": "progress", "state": "running", "time": 1, "progress": "{"},
    {"type": "progress", "state": "running", "time": 10**30},
    {"type": "state", "state": "running"},
    {},
]


def test_an_event_that_cannot_be_read_ends_no_watch(jobs: Jobs, caplog: pytest.LogCaptureFixture) -> None:
    """Neither one that follows its job, nor one that replays it, nor one of another job."""

    async def scenario() -> None:
        async with jobs.edge() as store:
            strange, other = [(await jobs.submit(store)).refinement.id for _ in range(2)]
            tasks = [await joined(store, strange), await joined(store, other)]
            for fields in STRANGE:
                sequence = jobs.redis.hincrby(keys.JOB + strange, "sequence", 1)
                jobs.redis.xadd(keys.EVENTS + strange, {"left": "out"} | fields, f"{sequence}-0")
            jobs.redis.publish(keys.DOORBELL, strange)
            finish(jobs, other)
            assert await asyncio.wait_for(tasks[1], 10) == [1, 2, 3, 4]
            tasks[1] = await joined(store, strange)
            finish(jobs, strange)
            assert await asyncio.wait_for(asyncio.gather(*tasks), 10) == [[1, 7, 8, 9]] * 2
            [line] = [record.getMessage() for record in caplog.records if "cannot be read" in record.message]
            assert strange in line

    run(scenario())


def test_a_state_of_a_newer_version_is_shown_as_it_is(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            steps = store.watch("ann", job_id)
            await anext(steps)
            jobs.redis.hset(keys.JOB + job_id, mapping={"state": "parked", "sequence": 2})
            jobs.redis.xadd(keys.EVENTS + job_id, {"type": "state", "state": "parked", "time": 1}, "2-0")
            jobs.redis.publish(keys.DOORBELL, job_id)
            assert (await asyncio.wait_for(anext(steps), 10)).state == "parked"
            assert (await store.get("ann", job_id)).state == "parked"
            await steps.aclose()

    run(scenario())


def test_a_record_that_cannot_be_read_ends_its_watch_only(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            strange, other = [(await jobs.submit(store)).refinement.id for _ in range(2)]
            steps = store.watch("ann", strange)
            await anext(steps)
            beside = await joined(store, other)
            job = jobs.worker.claim(strange, "slot-0")
            assert job
            jobs.redis.hset(keys.JOB + strange, "progress", "{}")
            jobs.worker.finish(job, [], JUDGEMENT)
            finish(jobs, other)
            last = [event async for event in steps][-1]
            assert (last.type, last.state, last.refinement) == (EventType.COMPLETED, State.SUCCEEDED, None)
            assert await asyncio.wait_for(beside, 10) == [1, 2, 3, 4]

    run(scenario())


def test_a_reader_that_was_stopped_is_started_again(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            first, second = [(await jobs.submit(store)).refinement.id for _ in range(2)]
            tasks = [await joined(store, first)]
            [reader] = [task for task in asyncio.all_tasks() if task.get_name() == "event feed"]
            while not reader.done():  # redis-py may take a cancellation for the timeout of a read
                reader.cancel()
                await asyncio.sleep(0.01)
            tasks.append(await joined(store, second))
            finish(jobs, first)
            finish(jobs, second)
            assert await asyncio.wait_for(asyncio.gather(*tasks), 10) == [[1, 2, 3, 4]] * 2

    run(scenario())


def test_a_watcher_far_ahead_ends_with_its_job(jobs: Jobs) -> None:
    """Who asks for events after one that will never be is told of the end by the end of the stream."""

    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            ahead = asyncio.create_task(watched(store, job_id, 1000))
            while not store.feed.watchers(job_id):
                await asyncio.sleep(0.01)
            finish(jobs, job_id)
            assert await asyncio.wait_for(ahead, 10) == []
            assert not store.feed.watchers(job_id)

    run(scenario())


def test_a_watcher_of_an_ended_job_whose_events_have_gone_ends(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            finish(jobs, job_id)
            jobs.redis.delete(keys.EVENTS + job_id)  # as a deletion does that comes in between
            assert await asyncio.wait_for(watched(store, job_id), 10) == []

    run(scenario())


def test_the_stream_is_bounded(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            for i in range(keys.EVENTS_KEPT):
                jobs.worker.report(job, progress(i))
            jobs.worker.finish(job, [], JUDGEMENT)
            events = await watched(store, job.id)
            assert len(events) == keys.EVENTS_KEPT
            assert events[-1].type is EventType.COMPLETED

    run(scenario())
