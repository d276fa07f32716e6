"""REST: server-sent events of a refinement."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import aclosing
from typing import Annotated

from fastapi import APIRouter, Depends, Header
from fastapi.sse import EventSourceResponse, ServerSentEvent

from ..edge.call import Call
from ..edge.edge import COLLECTION
from ..edge.follow import follow
from .depends import CallHere, EdgeHere, Found, the_call
from .openapi import EVENTS, problems

_RECONNECT_MS = 2000
_MAX_SEQUENCE = 2**63 - 1


async def the_place(edge: EdgeHere, call: CallHere) -> AsyncIterator[None]:
    """Held until the stream has ended; there is none: refused before it begins."""
    with edge.watchers.take(call.owner):
        yield


router = APIRouter(prefix=COLLECTION, tags=["refinements"])


@router.get(
    "/{refinement_id}/events",
    response_class=EventSourceResponse,
    responses={200: EVENTS, **problems(401, 403, 404, 410, 422, 429, 503)},
    dependencies=[Depends(the_place)],
)
async def watch_refinement(
    refinement: Found,
    edge: EdgeHere,
    call: Annotated[Call, Depends(the_call)],
    last_event_id: Annotated[
        int, Header(ge=0, le=_MAX_SEQUENCE, description="Replay what came after this event.")
    ] = 0,
) -> AsyncIterator[ServerSentEvent]:
    """The events so far and to come: `state`, `progress`, and `completed`, after which the stream ends."""
    with edge.metrics.watching("rest"):
        async with aclosing(follow(edge, call.owner, refinement.id, last_event_id)) as events:
            async for event in events:
                yield ServerSentEvent(
                    event=event.type, id=str(event.sequence), raw_data=event.model_dump_json()
                )
        if edge.draining.done():
            yield ServerSentEvent(comment="shutting down", retry=_RECONNECT_MS)
