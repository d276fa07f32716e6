"""What we rely on in the pinned version of RQ (../shared/notes/service.md, section 3)."""

from __future__ import annotations

import asyncio
import sys
import types
from typing import TYPE_CHECKING, Any

import pytest
from judgement import JUDGEMENT
from redis import Redis
from rq import Queue
from rq.job import Job as RqJob
from rq.serializers import JSONSerializer
from rq.worker import SimpleWorker

from refine_jobs import keys
from refine_jobs.delivery import TASK, Delivery, delivery_id, worker_queue
from refine_jobs.reaper import reap
from refine_proto.models import State

if TYPE_CHECKING:
    from .conftest import Jobs


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The ids that the task at TASK was called with. The worker's own module is not needed here."""
    calls: list[str] = []
    module_name, _, function = TASK.rpartition(".")
    package = module_name.rpartition(".")[0]
    module = types.ModuleType(module_name)
    setattr(module, function, calls.append)
    monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
    monkeypatch.setitem(sys.modules, module_name, module)
    return calls


def work(connection: Redis) -> None:
    queue = worker_queue(connection, "default")
    SimpleWorker([queue], connection=connection, serializer=JSONSerializer).work(burst=True)


def submit(jobs: Jobs, count: int) -> list[str]:
    async def post() -> list[str]:
        async with jobs.edge() as store:
            return [(await jobs.submit(store)).refinement.id for _ in range(count)]

    return asyncio.run(post())


def test_a_worker_takes_what_submit_queued_in_order(jobs: Jobs, rq_connection: Redis, ran: list[str]) -> None:
    ids = submit(jobs, 3)
    work(rq_connection)
    assert ran == ids


def test_our_commands_leave_what_rqs_own_enqueue_leaves(redis: Redis, rq_connection: Redis) -> None:
    queue = Queue("refine-default", connection=rq_connection, serializer=JSONSerializer)
    queue.enqueue(
        TASK, "x", job_id="x-1", job_timeout=150, result_ttl=60, failure_ttl=86_400, description="x"
    )
    theirs = rq_connection.hgetall("rq:job:x-1")
    assert redis.lrange("rq:queue:refine-default", 0, -1) == ["x-1"]
    rq_connection.flushall()
    queue_key, delivery, *words = Delivery("default").enqueue("x", 1, timeout_s=30)
    assert (queue_key, delivery) == (queue.key, "x-1")
    server: Any = rq_connection  # execute_command has no types
    while words:
        count, rest = words[0], words[1:]
        server.execute_command(*rest[:count])
        words = rest[count:]
    ours = rq_connection.hgetall("rq:job:x-1")
    times = {b"created_at", b"enqueued_at"}
    assert {k: v for k, v in ours.items() if k not in times} == {
        k: v for k, v in theirs.items() if k not in times
    }
    assert redis.lrange("rq:queue:refine-default", 0, -1) == ["x-1"]
    assert redis.smembers("rq:queues") == {"rq:queue:refine-default"}


def test_only_the_id_travels_as_json(jobs: Jobs, rq_connection: Redis) -> None:
    [job_id] = submit(jobs, 1)
    rq_job = RqJob.fetch(delivery_id(job_id, 1), connection=rq_connection, serializer=JSONSerializer)
    assert (rq_job.func_name, rq_job.args, rq_job.kwargs) == (TASK, [job_id], {})
    assert rq_job.timeout == jobs.settings.job_timeout_s + keys.RQ_TIMEOUT_MARGIN_S
    assert (rq_job.result_ttl, rq_job.failure_ttl) == (keys.RQ_RESULT_S, keys.RQ_FAILURE_S)
    assert b"glTF" not in rq_job.data
    assert rq_job.data.startswith(b"[")  # JSON, not pickle


def test_a_single_queue_is_taken_through_the_intermediate_list(jobs: Jobs, rq_connection: Redis) -> None:
    """The copy from which a job is found again whose worker died between taking and starting it."""
    [job_id] = submit(jobs, 1)
    queue = worker_queue(rq_connection, "default")
    taken = Queue.dequeue_any([queue], timeout=None, connection=rq_connection, serializer=JSONSerializer)
    assert taken
    assert jobs.redis.lrange(queue.intermediate_queue_key, 0, -1) == [delivery_id(job_id, 1)]
    jobs.redis.hset(keys.MISSING, job_id, "1")
    assert reap(jobs.worker, jobs.blobs).requeued == (job_id,)


def test_a_delivery_in_two_places_starts_once(jobs: Jobs) -> None:
    [job_id] = submit(jobs, 1)
    assert jobs.worker.claim(job_id, "slot-0")
    assert jobs.worker.claim(job_id, "slot-1") is None


def test_a_cancelled_delivery_in_a_workers_hands_does_nothing(
    jobs: Jobs, rq_connection: Redis, ran: list[str]
) -> None:
    first, second = submit(jobs, 2)

    async def cancel() -> None:
        async with jobs.edge() as store:
            await store.cancel("ann", first)

    queue = worker_queue(rq_connection, "default")
    rq_connection.lmove(queue.key, queue.intermediate_queue_key)  # a worker has just taken the first
    asyncio.run(cancel())
    rq_connection.lmove(queue.intermediate_queue_key, queue.key, "RIGHT", "LEFT")
    work(rq_connection)  # RQ finds no job under this id and goes on
    assert ran == [second]


def test_rqs_failure_does_not_touch_the_record(
    jobs: Jobs, rq_connection: Redis, ran: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    [job_id] = submit(jobs, 1)

    def crash_after_success(given: str) -> None:
        job = jobs.worker.claim(given, "slot-0")
        assert job
        jobs.worker.finish(job, [], JUDGEMENT)
        raise RuntimeError("after the end")

    module_name, _, function = TASK.rpartition(".")
    monkeypatch.setattr(sys.modules[module_name], function, crash_after_success)
    work(rq_connection)
    rq_job = RqJob.fetch(delivery_id(job_id, 1), connection=rq_connection, serializer=JSONSerializer)
    assert rq_job.is_failed
    assert jobs.redis.hget(keys.JOB + job_id, "state") == State.SUCCEEDED
    assert 0 < rq_connection.ttl(rq_job.key) <= keys.RQ_FAILURE_S
    assert ran == []


def test_a_later_attempt_has_its_own_delivery(jobs: Jobs, rq_connection: Redis, ran: list[str]) -> None:
    [job_id] = submit(jobs, 1)
    jobs.worker.claim(job_id, "slot-0")
    jobs.redis.delete("rq:queue:refine-default")
    jobs.end_lease(job_id)
    reap(jobs.worker, jobs.blobs)
    assert jobs.redis.lrange("rq:queue:refine-default", 0, -1) == [delivery_id(job_id, 2)]
    work(rq_connection)
    assert ran == [job_id]


def test_a_finished_delivery_leaves_rq_by_itself(jobs: Jobs, rq_connection: Redis, ran: list[str]) -> None:
    [job_id] = submit(jobs, 1)
    work(rq_connection)
    assert ran == [job_id]
    assert 0 < rq_connection.ttl(RqJob.key_for(delivery_id(job_id, 1))) <= keys.RQ_RESULT_S
