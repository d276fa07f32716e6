"""One reader for all watchers of a process, on one subscribed Redis connection.

Every event rings a channel with the job's id. The reader fetches the new entries of that job's stream once,
decodes them once and hands them to each of its watchers. Rings can be lost (a reconnect), events cannot: they
are in the stream, and the reader looks at every watched stream now and then without a ring.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import suppress
from typing import Any

from redis.asyncio import Redis
from redis.asyncio.client import PubSub
from redis.exceptions import RedisError

from refine_proto.models import Event, EventType, Refinement

from . import keys
from .record import decode_event

_LOOK_S = 5.0  # without a ring
_RECONNECT_S = 1.0

log = logging.getLogger(__name__)


class _Topic:
    """The watchers of one job in this process."""

    def __init__(self) -> None:
        self.watchers: set[asyncio.Queue[Event]] = set()
        self.read = 0  # sequence of the last event handed out


class EventFeed:
    """Streams of events. `find` gives the Refinement of a completed event, or None if it is gone."""

    def __init__(self, redis: Redis, find: Callable[[str], Awaitable[Refinement | None]]) -> None:
        self._redis: Any = redis  # redis-py's types cannot say that it decodes responses
        self._find = find
        self._topics: dict[str, _Topic] = {}
        self._reader: asyncio.Task[None] | None = None
        self._closed = False

    async def follow(self, job_id: str, after_sequence: int) -> AsyncIterator[Event]:
        """The events after a sequence number, those that were and those to come, to the completed one."""
        queue: asyncio.Queue[Event] = asyncio.Queue()
        topic = self._topics.setdefault(job_id, _Topic())
        topic.watchers.add(queue)  # before the replay, so that nothing falls between
        self._reader = self._reader or asyncio.create_task(self._read_forever(), name="event feed")
        try:
            last = after_sequence
            replay = await self._fetch(job_id, after_sequence)
            topic.read = max(topic.read, *(event.sequence for event in replay), 0)
            for event in replay:
                last = event.sequence
                yield event
                if event.type is EventType.COMPLETED:
                    return
            while True:
                event = await queue.get()
                if event.sequence <= last:
                    continue
                last = event.sequence
                yield event
                if event.type is EventType.COMPLETED:
                    return
        finally:
            topic.watchers.discard(queue)
            if not topic.watchers:
                self._topics.pop(job_id, None)

    async def close(self) -> None:
        """Stop the reader; watchers get nothing more."""
        self._closed = True  # redis-py may take a cancellation for the timeout of a read and go on
        if self._reader is not None:
            self._reader.cancel()
            with suppress(asyncio.CancelledError):
                await self._reader

    async def _read_forever(self) -> None:
        while not self._closed:
            try:
                async with self._redis.pubsub(ignore_subscribe_messages=True) as bell:
                    await bell.subscribe(keys.DOORBELL)
                    await self._hand_out(list(self._topics))  # what rang while nobody listened
                    while not self._closed:
                        await self._hand_out(await self._rung(bell))
            except RedisError as error:
                log.warning("event feed: %s; again in %s s", error, _RECONNECT_S)
                await asyncio.sleep(_RECONNECT_S)

    async def _rung(self, bell: PubSub) -> Iterable[str]:
        """The jobs that rang; after _LOOK_S of silence, all that are watched."""
        message = await bell.get_message(timeout=_LOOK_S)
        if message is None:
            return list(self._topics)
        rung = set()
        while message is not None:  # a burst is read as one
            rung.add(message["data"])
            message = await bell.get_message(timeout=0.0)
        return rung

    async def _hand_out(self, job_ids: Iterable[str]) -> None:
        for job_id in job_ids:
            topic = self._topics.get(job_id)
            if topic is None:
                continue
            for event in await self._fetch(job_id, topic.read):
                topic.read = max(topic.read, event.sequence)
                for watcher in topic.watchers:
                    watcher.put_nowait(event)

    async def _fetch(self, job_id: str, after_sequence: int) -> list[Event]:
        entries = await self._redis.xrange(keys.EVENTS + job_id, min=f"({after_sequence}-0")
        events = [decode_event(entry) for entry in entries]
        if events and events[-1].type is EventType.COMPLETED:
            events[-1] = events[-1].model_copy(update={"refinement": await self._find(job_id)})
        return events
