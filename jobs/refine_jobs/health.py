"""What readiness and metrics need to know, across all processes."""

from __future__ import annotations

from typing import Any

from redis.asyncio import Redis

from . import keys
from .redis_server import unavailable
from .slots import SlotStatus


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
    async def metrics(self) -> dict[str, int]:
        """Counters, histograms and gauges by name.

        `jobs:<state>:<reason>` ended jobs; `queue_s:<bound>` and `run_s:<bound>` jobs that took up to bound
        seconds and more than the bound before (`inf` the rest), `queue_s:sum_ms` and `run_s:sum_ms` in total;
        `queued` and `running` now.
        """
        async with self._redis.pipeline(transaction=False) as pipe:
            pipe.hgetall(keys.METRICS)
            pipe.zcard(keys.QUEUED)
            pipe.zcard(keys.LEASES)
            counters, queued, running = await pipe.execute()
        return {name: int(value) for name, value in counters.items()} | {"queued": queued, "running": running}

    @unavailable
    async def check_writable(self) -> None:
        """Raise Unavailable unless Redis takes writes."""
        await self._redis.set(keys.PROBE, "", px=1000)
