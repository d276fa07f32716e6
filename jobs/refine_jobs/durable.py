"""Waits until what was written has reached the append-only file of Redis.

Redis answers before that. A server that is killed with a full disk, or a machine that loses its power, would
otherwise forget what somebody was promised.
"""

from __future__ import annotations

import asyncio
from typing import Any

from redis.exceptions import ResponseError

from refine_proto.errors import Unavailable

from . import keys
from .redis_server import FULL_RETRY_S

_PATIENCE_S = 5.0
_ROUNDS = 4  # under way at a time: each has a connection for as long as the disk takes


class Durable:
    """For one event loop. Callers share rounds, so that a slow disk does not use up the connections."""

    def __init__(self, redis: Any) -> None:
        self._redis = redis
        self._slots = asyncio.Semaphore(_ROUNDS)
        self._next: asyncio.Task[bool] | None = None

    async def written(self) -> None:
        """Return once all that this process has written so far is in the file; raises Unavailable if not."""
        if self._next is None:
            self._next = asyncio.create_task(self._round())
        if not await asyncio.shield(self._next):
            raise Unavailable(
                "the job store has not written this to its disk; send it again with the same idempotency key",
                retry_after_s=FULL_RETRY_S,
            )

    async def _round(self) -> bool:
        async with self._slots:
            self._next = None  # who comes from here on may have written too late for this round
            async with self._redis.client() as connection:
                # WAITAOF waits for the writes of its connection; earlier ones stand before them in the file.
                await connection.set(keys.PROBE, "", px=1000)
                try:
                    local, _ = await connection.execute_command("WAITAOF", 1, 0, int(_PATIENCE_S * 1000))
                except ResponseError as error:
                    if "unknown command" in str(error):  # an older server, which syncs every write
                        return True
                    raise
                return bool(local)
