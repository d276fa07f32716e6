"""No owner waits for another's pile of jobs: the order in which slots get jobs, on a real Redis."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import pytest
from judgement import JUDGEMENT

from refine_jobs import keys
from refine_jobs.edge_store import JobStore
from refine_jobs.health import Health
from refine_jobs.record import Job, Task
from refine_jobs.redis_server import connect_async
from refine_jobs.share import Share, estimated_cost_ms
from refine_jobs.slots import SlotState, SlotStatus
from refine_proto.models import Preset, Priority, RefinementOptions, RefinementSpec, Validation

if TYPE_CHECKING:
    from .conftest import HandClock, Jobs

SPEC = RefinementSpec.model_validate(
    {"camera": {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.9}}
)
RQ_QUEUE = "rq:queue:refine-default"


async def submit(
    jobs: Jobs,
    store: JobStore,
    owner: str,
    priority: Priority = Priority.NORMAL,
    preset: Preset = Preset.DEFAULT,
    task: Task = Task.REFINE,
) -> str:
    spec = SPEC.model_copy(update={"options": RefinementOptions(priority=priority, preset=preset)})
    return (await jobs.submit(store, owner, spec=spec, task=task)).refinement.id


def take(jobs: Jobs) -> Job:
    """What a slot does: RQ's first delivery, and the job that it names."""
    job = jobs.worker.claim(str(jobs.redis.lpop(RQ_QUEUE)).rpartition("-")[0], "slot")
    assert job is not None
    return job


def owners(taken: Sequence[Job]) -> Counter[str]:
    return Counter(job.owner for job in taken)


def test_a_single_job_does_not_wait_for_anothers_pile(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            for _ in range(50):
                await submit(jobs, store, "greedy")
            begun = [take(jobs) for _ in range(5)]
            single = await submit(jobs, store, "ann")
            assert (await store.get("ann", single)).queue_position == 0
            assert take(jobs).id == single
            assert owners(begun) == {"greedy": 5}

    asyncio.run(steps())


def test_with_a_hundred_owners_a_new_one_waits_for_one_round_at_most(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            for owner in range(100):
                for _ in range(3):
                    await submit(jobs, store, f"owner-{owner}", preset=list(Preset)[owner % 3])
            for _ in range(130):  # in the middle of a round
                take(jobs)
            first = await submit(jobs, store, "new")
            before = []
            while (job := take(jobs)).id != first:
                before.append(job)
            assert max(owners(before).values(), default=0) <= 1

    asyncio.run(steps())


def test_owners_get_the_same_work_and_not_the_same_number_of_jobs(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            for _ in range(40):
                await submit(jobs, store, "short", preset=Preset.FAST)
            for _ in range(10):
                await submit(jobs, store, "long", preset=Preset.PAPER)
            work: Counter[str] = Counter()
            for _ in range(20):
                job = take(jobs)
                assert job.cost_ms is not None
                work[job.owner] += job.cost_ms
            longest = estimated_cost_ms(
                SPEC.model_copy(update={"options": RefinementOptions(preset="paper")}), 4
            )
            assert abs(work["short"] - work["long"]) <= longest

    asyncio.run(steps())


def test_priorities_start_sooner_or_later_than_others(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            low = await submit(jobs, store, "ann", Priority.LOW)
            normal = [await submit(jobs, store, owner) for owner in ("bob", "cat", "dan")]
            high = await submit(jobs, store, "eve", Priority.HIGH)
            own = await submit(jobs, store, "bob", Priority.HIGH)
            assert [take(jobs).id for _ in range(6)] == [high, own, *normal, low]

    asyncio.run(steps())


@pytest.mark.parametrize("busy", list(Priority))
def test_no_priority_starves(jobs: Jobs, busy: Priority) -> None:
    """However long others keep the queue full, a low job starts after so much of their work."""

    async def steps() -> None:
        async with jobs.edge() as store:
            for owner in ("bob", "cat"):
                await submit(jobs, store, owner, busy)
            low = await submit(jobs, store, "ann", Priority.LOW)
            work_ms: Counter[str] = Counter()
            while (job := take(jobs)).id != low:
                work_ms[job.owner] += job.cost_ms or 0
                assert max(work_ms.values()) < 4 * (120_000 + 2 * (job.cost_ms or 0))
                await submit(jobs, store, job.owner, busy)

    asyncio.run(steps())


def test_who_cancels_a_pile_has_not_paid_for_it(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            pile = [await submit(jobs, store, "ann") for _ in range(20)]
            others = [await submit(jobs, store, "bob") for _ in range(5)]
            for job_id in pile[:10]:
                await store.cancel("ann", job_id)
            for job_id in pile[10:19]:
                await store.delete("ann", job_id)
            assert (await store.get("ann", pile[-1])).queue_position == 0
            assert [take(jobs).id for _ in range(2)] == [pile[-1], others[0]]

    asyncio.run(steps())


def test_a_lost_attempt_costs_no_turn(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            for _ in range(3):
                await submit(jobs, store, "ann")
            await submit(jobs, store, "bob")
            job = take(jobs)
            take(jobs)
            jobs.worker.give_back(job, "the worker shuts down")
            assert take(jobs).id == job.id

    asyncio.run(steps())


def test_questions_go_before_all_refinements_and_are_fair_among_themselves(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            await submit(jobs, store, "ann", Priority.HIGH)
            asked = [await submit(jobs, store, "ann", task=Task.VALIDATE) for _ in range(3)]
            other = await submit(jobs, store, "bob", task=Task.VALIDATE)
            assert [take(jobs).id for _ in range(4)] == [asked[0], other, *asked[1:]]

    asyncio.run(steps())


def test_questions_are_counted_apart(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            await submit(jobs, store, "ann", task=Task.VALIDATE)
            question = take(jobs)
            jobs.worker.answer(question, Validation(accepted=True, silhouette_iou=0.9))
            await submit(jobs, store, "ann")
            jobs.worker.finish(take(jobs), [], JUDGEMENT)
            connection = connect_async(jobs.url)
            counted = (await Health(connection).installation()).counters
            await connection.aclose()
        ends = ("questions:succeeded:", "jobs:succeeded:", "submitted:questions", "submitted:refinements")
        assert [counted.get(name) for name in ends] == [1] * 4
        for histogram in ("queue_s", "run_s"):
            assert sum(v for n, v in counted.items() if n.startswith(histogram) and "sum" not in n) == 1

    asyncio.run(steps())


def test_an_empty_queue_owes_nobody_anything(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            for _ in range(5):
                await submit(jobs, store, "ann")
            for _ in range(5):
                take(jobs)
            assert jobs.redis.exists(keys.FLOWS, keys.QUEUED_COST, f"{keys.FLOW}ann:normal") == 0
            first = await submit(jobs, store, "ann")
            await submit(jobs, store, "bob")
            assert take(jobs).id == first

    asyncio.run(steps())


def test_flows_whose_time_has_come_are_forgotten(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            for owner in range(20):
                await submit(jobs, store, f"owner-{owner}")
            for _ in range(3):
                await submit(jobs, store, "ann")
            for _ in range(21):
                take(jobs)
            assert jobs.redis.zcard(keys.FLOWS) == 21
            take(jobs)
            assert jobs.redis.zrange(keys.FLOWS, 0, -1) == ["ann:normal"]

    asyncio.run(steps())


def test_a_job_that_a_former_version_queued_is_run(jobs: Jobs) -> None:
    async def steps() -> None:
        async with jobs.edge() as store:
            old, other = await submit(jobs, store, "ann"), await submit(jobs, store, "ann")
            jobs.redis.hdel(keys.JOB + old, *vars(Share("", 0, 0, 0)))
            jobs.redis.zrem(f"{keys.FLOW}ann:normal", old)
            jobs.redis.zadd(keys.QUEUED, {old: 1})
            assert (await store.get("ann", old)).eta_s is None
            assert [take(jobs).id for _ in range(2)] == [old, other]

    asyncio.run(steps())


def test_when_a_job_is_expected_to_end(jobs: Jobs, clock: HandClock) -> None:
    """Runs take twice as long as estimated; two slots."""
    jobs = jobs.with_clock(clock)

    async def steps() -> None:
        async with jobs.edge() as store:
            for number in range(2):
                jobs.worker.show(SlotStatus(name=f"slot-{number}", device="cpu", state=SlotState.IDLE))
            ids = [await submit(jobs, store, "ann") for _ in range(6)]
            assert (await store.get("ann", ids[0])).eta_s is None  # nothing has run here
            job = take(jobs)
            cost_s = (job.cost_ms or 0) / 1000
            clock.move(2 * cost_s)
            jobs.worker.finish(job, [], JUDGEMENT)
            took_s = int(2000 * cost_s) / 1000
            assert float(str(jobs.redis.get(keys.PACE))) == pytest.approx(2, rel=1e-3)
            expected = [(await store.get("ann", job_id)).eta_s for job_id in ids[1:]]
            waits = (0, 0, 0.5, 1, 1.5)  # of a run: two slots are free, then one every half run
            assert expected == pytest.approx([(wait + 1) * took_s for wait in waits], rel=1e-2)
            listed = (await store.list("ann")).refinements
            assert [shown.eta_s for shown in listed[::-1]] == [None, *expected]

    asyncio.run(steps())
