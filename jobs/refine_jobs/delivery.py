"""The only module that speaks RQ: which commands put a job into its queue and take it out again.

RQ delivers, it does not keep: the truth is the record. RQ composes its commands on a pipeline that is never
executed; our scripts run them in the same atomic step as the change of the record. Every delivery has an id
of its own, `<job id>-<attempt>`, so that what RQ still believes of a lost one cannot touch the next. Only the
job id travels, as JSON.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from redis import Redis
from redis.client import Pipeline
from rq import Queue
from rq.job import Job as RqJob
from rq.job import JobStatus
from rq.serializers import JSONSerializer

from . import keys

TASK = "refine_worker.slot.task.run"
FORMER_TASK = "refine_worker.task.run"  # of jobs that 0.1.0 put into the queue
MINIMUM_REDIS = (6, 2, 0)  # BLMOVE, with which RQ keeps a copy of a job that it takes

Words = list[Any]


class Delivery:
    """The queue of one pool, as words for the scripts. It never talks to Redis."""

    def __init__(self, pool: str) -> None:
        self._redis = Redis()  # connects on the first command, and none is sent
        self.queue = Queue(keys.queue(pool), connection=self._redis, serializer=JSONSerializer)
        self.queue.redis_server_version = MINIMUM_REDIS  # RQ would ask the server

    def enqueue(self, job_id: str, attempt: int, timeout_s: float) -> Words:
        """What delivers the job for its `attempt` (1 the first time): RQ's list, the delivery, RQ's commands.

        RQ appends to its list; the script moves the delivery to where it belongs.
        """
        delivery = self.queue.create_job(
            TASK,
            args=(job_id,),
            job_id=delivery_id(job_id, attempt),
            timeout=math.ceil(timeout_s) + keys.RQ_TIMEOUT_MARGIN_S,
            result_ttl=keys.RQ_RESULT_S,
            failure_ttl=keys.RQ_FAILURE_S,
            status=JobStatus.QUEUED,
            description=job_id,
        )
        commands = self._record(lambda p: self.queue.enqueue_job(delivery, pipeline=p))
        return [self.queue.key, delivery.id, *commands]

    def withdraw(self, job_id: str, attempt: int) -> Words:
        """What takes a delivery out of the queue, harmless if a worker has it: RQ's list, the commands."""
        rq_id = delivery_id(job_id, attempt)

        def remove(pipeline: Pipeline) -> None:
            self.queue.remove(rq_id, pipeline=pipeline)
            pipeline.delete(RqJob.key_for(rq_id))

        return [self.queue.key, *self._record(remove)]

    def _record(self, speak: Callable[[Pipeline], object]) -> Words:
        pipeline = self._redis.pipeline()
        speak(pipeline)
        commands = [list(words) for words, _ in pipeline.command_stack]
        return [word for command in commands for word in (len(command), *command)]


def delivery_id(job_id: str, attempt: int) -> str:
    """RQ's id of the delivery that starts `attempt`."""
    return f"{job_id}-{attempt}"


@cache
def delivery_of(pool: str) -> Delivery:
    """That of a pool: whoever gives back or withdraws a job need not be of the pool that it is for."""
    return Delivery(pool)


def worker_queue(connection: Any, pool: str) -> Queue:
    """The queue that a worker of the pool listens to; `connection` must not decode responses."""
    return Queue(keys.queue(pool), connection=connection, serializer=JSONSerializer)
