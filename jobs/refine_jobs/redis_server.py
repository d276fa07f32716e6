"""Connections to Redis, and what a server must be for jobs to be safe in it."""

from __future__ import annotations

import functools
from collections.abc import Awaitable, Callable
from typing import Any, ParamSpec, TypeVar

import redis.asyncio
from redis import Redis
from redis.exceptions import ConnectionError, OutOfMemoryError, ReadOnlyError, TimeoutError

from refine_proto.errors import Unavailable

from .delivery import MINIMUM_REDIS

MAX_CONNECTIONS = 32  # of one process; more calls wait their turn
RETRY_S = 2.0  # when Redis is away
P = ParamSpec("P")
R = TypeVar("R")
_OPTIONS: dict[str, Any] = {
    "decode_responses": True,
    "health_check_interval": 30,
    "socket_connect_timeout": 5,
}


class RedisUnfit(Exception):
    """The server is no place for jobs; the message says what to change."""


def connect(url: str) -> Redis:
    """A connection for WorkerStore."""
    return Redis.from_url(url, **_OPTIONS)


def connect_for_rq(url: str) -> Redis:
    """A connection for RQ's own worker, which reads bytes."""
    return Redis.from_url(url, **(_OPTIONS | {"decode_responses": False}))


def connect_async(url: str) -> redis.asyncio.Redis:
    """A connection for JobStore; belongs to the running event loop."""
    pool = redis.asyncio.BlockingConnectionPool.from_url(
        url, max_connections=MAX_CONNECTIONS, timeout=10, **_OPTIONS
    )
    return redis.asyncio.Redis.from_pool(pool)


def unavailable(call: Callable[P, Awaitable[R]]) -> Callable[P, Awaitable[R]]:
    """Tell a Redis that is away or full as UNAVAILABLE."""

    @functools.wraps(call)
    async def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return await call(*args, **kwargs)
        except (ConnectionError, TimeoutError, OutOfMemoryError, ReadOnlyError) as error:
            raise Unavailable("the job store does not answer; try again", retry_after_s=RETRY_S) from error

    return guarded


def check_server(server: Redis) -> None:
    """Raise RedisUnfit unless the server keeps what it is given and is new enough."""
    info: dict[str, Any] = server.info()
    policy = info.get("maxmemory_policy", "unknown")
    if policy != "noeviction":
        raise RedisUnfit(
            f"expected Redis with maxmemory-policy noeviction, got {policy}: it deletes queued jobs when "
            "memory runs out; run `redis-cli config set maxmemory-policy noeviction` (and in its config file)"
        )
    version = tuple(int(part) for part in str(info["redis_version"]).split(".")[:2])
    if version < MINIMUM_REDIS[:2]:
        wanted = ".".join(map(str, MINIMUM_REDIS))
        raise RedisUnfit(f"expected Redis {wanted} or newer (or Valkey), got {info['redis_version']}")
