"""One reader for all watchers of a process, on one subscribed Redis connection.

Every event rings a channel with the job's id. The reader fetches the new entries of the streams that rang, in
one round trip, decodes them once and hands them to each of their watchers. Rings can be lost (a reconnect),
events cannot: they are in the stream, and the reader looks at every watched stream now and then unasked. Only
the reader moves the place up to which a stream is handed out; who joins reads what came before by itself.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

from redis.asyncio import Redis
from redis.asyncio.client import PubSub
from redis.exceptions import RedisError

from refine_proto.models import Event, EventType, Refinement

from . import keys
from .record import Entry, Job, decode_event, sequence_of

_LOOK_S = 5.0  # without a ring
_PAUSE_S = 1.0  # after an error
_BURST = 1000  # rings that are answered together

log = logging.getLogger(__name__)


class _Topic:
    """The watchers of one job in this process."""

    def __init__(self, handed_out: int) -> None:
        self.watchers: set[asyncio.Queue[Event]] = set()
        self.handed_out = handed_out  # sequence of the last event; who joins finds it in the stream
        self.complained = False  # of an event that cannot be read


class EventFeed:
    """Streams of events. `find` gives the Refinement of a completed event, or None if it cannot."""

    def __init__(self, redis: Redis, find: Callable[[str], Awaitable[Refinement | None]]) -> None:
        self._redis: Any = redis  # redis-py's types cannot say that it decodes responses
        self._find = find
        self._topics: dict[str, _Topic] = {}
        self._reader: asyncio.Task[None] | None = None
        self._closed = False

    async def follow(self, job: Job, after_sequence: int) -> AsyncGenerator[Event, None]:
        """The events after a sequence number, those that were and those to come, to the completed one."""
        queue: asyncio.Queue[Event] = asyncio.Queue()
        topic = self._topics.setdefault(job.id, _Topic(job.sequence))
        topic.watchers.add(queue)  # before the replay, so that nothing falls between
        if self._reader is None or self._reader.done():
            self._reader = asyncio.create_task(self._read_forever(), name="event feed")
        try:
            last = after_sequence
            [entries] = await self._fetch({job.id: last})
            replay = deque(await self._decode(job.id, topic, entries))
            while replay or not job.state.terminal:
                event = replay.popleft() if replay else await queue.get()
                if event.sequence > last:  # some come by both ways
                    last = event.sequence
                    yield event
                if event.type is EventType.COMPLETED:
                    return
        finally:
            topic.watchers.discard(queue)
            if not topic.watchers:
                self._topics.pop(job.id, None)

    def watchers(self, job_id: str) -> int:
        """How many follow the job in this process."""
        topic = self._topics.get(job_id)
        return len(topic.watchers) if topic else 0

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
                    await self._hand_out(self._topics)  # what rang while nobody listened
                    while not self._closed:
                        await self._hand_out(await self._rung(bell))
            except RedisError as error:
                log.warning("event feed: %s; again in %s s", error, _PAUSE_S)
                await asyncio.sleep(_PAUSE_S)
            except Exception:
                log.exception("event feed: unexpected; again in %s s", _PAUSE_S)
                await asyncio.sleep(_PAUSE_S)

    async def _rung(self, bell: PubSub) -> Iterable[str]:
        """The jobs that rang; after _LOOK_S of silence, all that are watched."""
        message = await bell.get_message(timeout=_LOOK_S)
        if message is None:
            return self._topics
        rung = {message["data"]}
        for _ in range(_BURST):
            message = await bell.get_message(timeout=0.0)
            if message is None:
                break
            rung.add(message["data"])
        return rung

    async def _hand_out(self, job_ids: Iterable[str]) -> None:
        topics = {job_id: topic for job_id in job_ids if (topic := self._topics.get(job_id))}
        streams = await self._fetch({job_id: topic.handed_out for job_id, topic in topics.items()})
        for (job_id, topic), entries in zip(topics.items(), streams, strict=True):
            events = await self._decode(job_id, topic, entries)
            for event in events:
                for watcher in topic.watchers:
                    watcher.put_nowait(event)
            if entries:
                topic.handed_out = sequence_of(entries[-1])

    async def _fetch(self, after: Mapping[str, int]) -> list[list[Entry]]:
        """Of each job the entries of its stream after a sequence number."""
        async with self._redis.pipeline(transaction=False) as pipe:
            for job_id, sequence in after.items():
                pipe.xrange(keys.EVENTS + job_id, min=f"({sequence}-0")
            streams: list[list[Entry]] = await pipe.execute()
        return streams

    async def _decode(self, job_id: str, topic: _Topic, entries: Iterable[Entry]) -> list[Event]:
        """The events that this version knows; what cannot be read is left out and logged once per job."""
        events = []
        for entry in entries:
            try:
                event = decode_event(entry)
            except Exception as error:
                if not topic.complained:
                    log.warning("event feed: an event of job %s cannot be read: %s", job_id, error)
                topic.complained = True
                continue
            if event is not None and event.type is EventType.COMPLETED:
                event = event.model_copy(update={"refinement": await self._find(job_id)})
            if event is not None:
                events.append(event)
        return events
