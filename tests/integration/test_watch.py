"""Watching jobs: replay, live events, many watchers."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from refine_jobs import keys
from refine_jobs.edge_store import JobStore
from refine_proto.models import Event, EventType, Progress, SilhouetteIou, State

if TYPE_CHECKING:
    from .conftest import Jobs

IOU = SilhouetteIou(before=0.5, after=0.9)


def progress(iteration: int) -> Progress:
    return Progress(iteration=iteration, total=10, percent=10.0 * iteration)


async def watched(store: JobStore, job_id: str, after: int = 0) -> list[Event]:
    return [event async for event in store.watch("ann", job_id, after)]


def test_replay_from_a_sequence(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            for i in (1, 2):
                jobs.worker.report(job, progress(i))
            jobs.worker.finish(job, [], IOU)
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

    asyncio.run(scenario())


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

    asyncio.run(scenario())


def test_watchers_of_a_deleted_job_are_told(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            task = asyncio.create_task(watched(store, job_id))
            await asyncio.sleep(0.1)
            await store.delete("ann", job_id)
            events = await asyncio.wait_for(task, 10)
            assert (events[-1].type, events[-1].state) == (EventType.COMPLETED, State.EXPIRED)
            assert events[-1].refinement is None

    asyncio.run(scenario())


def test_hundreds_of_watchers_share_few_connections(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            ids = [(await jobs.submit(store)).refinement.id for _ in range(5)]
            tasks = [asyncio.create_task(watched(store, ids[i % 5])) for i in range(300)]
            await asyncio.sleep(0.5)
            connections = int(jobs.redis.info("clients")["connected_clients"])
            assert connections < 40
            for job_id in ids:
                job = jobs.worker.claim(job_id, "slot-0")
                assert job
                jobs.worker.report(job, progress(1))
                jobs.worker.finish(job, [], IOU)
            histories = await asyncio.wait_for(asyncio.gather(*tasks), 30)
            assert {tuple(e.sequence for e in history) for history in histories} == {(1, 2, 3, 4)}

    asyncio.run(scenario())


def test_a_feed_that_loses_its_connection_misses_nothing(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job_id = (await jobs.submit(store)).refinement.id
            task = asyncio.create_task(watched(store, job_id))
            await asyncio.sleep(0.2)
            jobs.redis.client_kill_filter(_type="pubsub")
            job = jobs.worker.claim(job_id, "slot-0")
            assert job
            jobs.worker.finish(job, [], IOU)
            assert [e.sequence for e in await asyncio.wait_for(task, 20)] == [1, 2, 3]

    asyncio.run(scenario())


def test_the_stream_is_bounded(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            job = jobs.worker.claim((await jobs.submit(store)).refinement.id, "slot-0")
            assert job
            for i in range(keys.EVENTS_KEPT):
                jobs.worker.report(job, progress(i))
            jobs.worker.finish(job, [], IOU)
            events = await watched(store, job.id)
            assert len(events) == keys.EVENTS_KEPT
            assert events[-1].type is EventType.COMPLETED

    asyncio.run(scenario())
