"""What readiness and metrics need to know, across all processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from redis.asyncio import Redis

from . import keys
from .redis_server import unavailable
from .slots import SlotStatus

_WRITES = ("aof_last_write_status", "aof_last_bgrewrite_status", "rdb_last_bgsave_status")


@dataclass(frozen=True)
class Installation:
    """Jobs and their Redis at one moment, the same whoever asks.

    `counters` has `submitted:refinements`, `submitted:questions`; `jobs:<state>:<reason>` ended refinements,
    `questions:<state>:<reason>` ended questions; `requeued:<cause>` attempts that ended before their
    job did; `queue_s:<bound>` and `run_s:<bound>` durations of up to bound seconds and more than the bound
    before (`inf` the rest), `queue_s:sum_ms` and `run_s:sum_ms` in total.
    """

    counters: Mapping[str, int]
    queued: int
    running: int
    oldest_queued_age_s: float  # 0 when nothing waits
    redis_persists: bool  # its last writes to disk have succeeded
    redis_used_bytes: int
    redis_max_bytes: int  # 0: no limit


class Health:
    """Reads what workers and scripts have counted. Raises Unavailable when Redis is away."""

    def __init__(self, redis: Redis) -> None:
        self._redis: Any = redis  # redis-py's types cannot say that it decodes responses

    @unavailable
    async def slots(self) -> tuple[SlotStatus, ...]:
        """The worker slots that are alive."""
        names = await self._redis.zrange(keys.SLOTS, 0, -1)
        found = await self._redis.mget([keys.SLOT + name for name in names]) if names else []
        return tuple(SlotStatus.model_validate_json(text) for text in found if text)

    @unavailable
    async def installation(self) -> Installation:
        """One round trip, whose cost does not depend on the number of jobs."""
        async with self._redis.pipeline(transaction=False) as pipe:
            pipe.hgetall(keys.METRICS)
            pipe.zcard(keys.QUEUED)
            pipe.zcard(keys.LEASES)
            pipe.zrange(keys.QUEUED_SINCE, 0, 0, withscores=True)
            pipe.time()
            pipe.info("persistence")
            pipe.info("memory")
            counters, queued, running, oldest, now, persistence, memory = await pipe.execute()
        now_s = now[0] + now[1] / 1e6
        return Installation(
            counters={name: int(value) for name, value in counters.items()},
            queued=queued,
            running=running,
            oldest_queued_age_s=max(0.0, now_s - oldest[0][1] / 1000) if oldest else 0.0,
            redis_persists=all(persistence.get(write, "ok") == "ok" for write in _WRITES),
            redis_used_bytes=memory["used_memory"],
            redis_max_bytes=memory["maxmemory"],
        )

    @unavailable
    async def check_writable(self) -> None:
        """Raise Unavailable unless Redis takes writes."""
        await self._redis.set(keys.PROBE, "", px=1000)
