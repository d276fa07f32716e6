"""What machines that run the service ask: is it alive, is it ready, what has it counted."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel

from refine_jobs.slots import SlotState
from refine_proto.errors import Unavailable

from ..edge.installation import count_slots, installation_exposition
from .depends import EdgeHere, the_scraper
from .openapi import problems

router = APIRouter(tags=["operations"])
_SLOT_RETRY_S = 10.0  # a worker takes longer than this to start
_METRICS: dict[str, Any] = {
    "description": "Prometheus' text format.",
    "content": {"text/plain": {"schema": {"type": "string"}}},
}


class Ready(BaseModel):
    """The service takes calls; `slots` are the worker slots that are alive, by what they do."""

    status: str = "ready"
    slots: dict[str, int]


@router.get("/livez")
async def live() -> dict[str, str]:
    """The process answers."""
    return {"status": "live"}


@router.get("/readyz", responses=problems(422, 503))
async def ready(
    edge: EdgeHere,
    slots: Annotated[int, Query(ge=0, description="How many worker slots that can work there must be.")] = 0,
) -> Ready:
    """Redis and the blob store take writes; 503 says which does not.

    Jobs are accepted without workers and wait for them; who wants to know of workers too asks `?slots=1`.
    """
    error = await edge.not_ready()
    if error is not None:
        raise error
    counts = count_slots(await edge.health.slots())
    able = counts[SlotState.IDLE] + counts[SlotState.BUSY]
    if able < slots:
        raise Unavailable(
            f"expected worker slots that can work: at least {slots}, got {able}; jobs wait for one",
            retry_after_s=_SLOT_RETRY_S,
        )
    return Ready(slots={str(state): count for state, count in counts.items()})


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: _METRICS, **problems(401, 403, 429)},
    dependencies=[Depends(the_scraper)],
)
async def metrics(edge: EdgeHere) -> Response:
    """Metrics of this process."""
    return Response(edge.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)


@router.get(
    "/metrics/installation",
    response_class=Response,
    responses={200: _METRICS, **problems(401, 403, 429, 503)},
    dependencies=[Depends(the_scraper)],
)
async def installation(edge: EdgeHere) -> Response:
    """Metrics of all jobs and workers, the same from every process of the installation: scrape one."""
    space = await asyncio.to_thread(edge.blobs.space)
    text = installation_exposition(await edge.health.installation(), await edge.health.slots(), space)
    return Response(text, media_type=CONTENT_TYPE_LATEST)
