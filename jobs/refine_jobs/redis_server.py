"""Connections to Redis, and what a server must be for jobs to be safe in it."""

from __future__ import annotations

import functools
from collections.abc import Awaitable, Callable
from typing import Any, ParamSpec, TypeVar

import redis.asyncio
from redis import Redis
from redis.exceptions import ConnectionError, OutOfMemoryError, ReadOnlyError, ResponseError, TimeoutError

from refine_proto.errors import Unavailable

from .delivery import MINIMUM_REDIS

MAX_CONNECTIONS = 32  # of one process; more calls wait their turn
RETRY_S = 2.0  # when Redis is away
FULL_RETRY_S = 5.0  # when it is full: somebody has to make room
P = ParamSpec("P")
R = TypeVar("R")
_OPTIONS: dict[str, Any] = {
    "decode_responses": True,
    "health_check_interval": 30,
    "socket_connect_timeout": 5,
}


WAITAOF_REDIS = (7, 2)  # older ones have to sync every write
_OR_ELSE = "(and in its config file), or set REFINE_SYNC_SUBMISSIONS=false to live with that"
_TAKES_NO_WRITES = (OutOfMemoryError, ReadOnlyError)
_DISK_FULL = "MISCONF"  # for which redis-py has no class


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
        except (ConnectionError, TimeoutError) as error:
            raise Unavailable("the job store does not answer; try again", retry_after_s=RETRY_S) from error
        except ResponseError as error:
            if not isinstance(error, _TAKES_NO_WRITES) and not str(error).startswith(_DISK_FULL):
                raise
            raise Unavailable(
                "the job store takes no writes; the service's log says why", retry_after_s=FULL_RETRY_S
            ) from error

    return guarded


def check_server(server: Redis, sync_submissions: bool = True) -> None:
    """Raise RedisUnfit unless the server keeps what it is given and is new enough.

    `sync_submissions`: it must also be able to say what has reached its append-only file.
    """
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
    if sync_submissions and not info.get("aof_enabled"):
        raise RedisUnfit(
            "expected Redis with an append-only file, got none: accepted submissions could be lost; run "
            f"`redis-cli config set appendonly yes` {_OR_ELSE}"
        )
    if sync_submissions and version < WAITAOF_REDIS and _appendfsync(server) != "always":
        raise RedisUnfit(
            f"expected Redis 7.2 or newer, or appendfsync always, got {info['redis_version']} with "
            f"{_appendfsync(server)}: accepted submissions could be lost; run `redis-cli config set "
            f"appendfsync always` {_OR_ELSE}"
        )


def _appendfsync(server: Redis) -> str:
    try:
        return str(server.config_get("appendfsync")["appendfsync"])
    except ResponseError:  # CONFIG is not for everybody
        return "an unknown appendfsync"
