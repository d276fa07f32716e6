"""Following a refinement: what SSE, WatchRefinement and `Prefer: wait` have in common."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import Any

from redis.exceptions import RedisError

from refine_proto.errors import Unavailable
from refine_proto.models import Event, Refinement

from .edge import Edge, with_urls


async def follow(
    edge: Edge, owner: str, refinement_id: str, after_sequence: int
) -> AsyncGenerator[Event, None]:
    """The events after a sequence number; ends after `completed`, or when the process drains."""
    async with aclosing(edge.store.watch(owner, refinement_id, after_sequence)) as events:
        while True:
            upcoming = asyncio.ensure_future(_next(events))
            either: set[asyncio.Future[Any]] = {upcoming, edge.draining}
            try:
                await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            finally:
                if not upcoming.done():
                    upcoming.cancel()
                    await asyncio.wait({upcoming})
            if upcoming.cancelled():
                return
            try:
                event = upcoming.result()
            except RedisError as error:
                raise Unavailable("the job store does not answer; watch again", retry_after_s=2.0) from error
            if event is None:
                return
            if event.refinement is not None:
                event = event.model_copy(update={"refinement": with_urls(event.refinement)})
            yield event


async def _next(events: AsyncGenerator[Event, None]) -> Event | None:
    return await anext(events, None)


async def wait_for_end(edge: Edge, owner: str, refinement_id: str, wait_s: float) -> Refinement:
    """The refinement as it is when it has ended or `wait_s` are over."""
    try:
        async with asyncio.timeout(wait_s), aclosing(follow(edge, owner, refinement_id, 0)) as events:
            async for _ in events:
                pass
    except TimeoutError:
        pass
    return await edge.refinement(owner, refinement_id)
