"""What machines that run the service ask: is it alive, is it ready, what has it counted."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST

from ..edge.prometheus import exposition
from .depends import EdgeHere
from .openapi import problems

router = APIRouter(tags=["operations"])
_METRICS: dict[str, Any] = {
    "description": "Prometheus' text format.",
    "content": {"text/plain": {"schema": {"type": "string"}}},
}


@router.get("/livez")
async def live() -> dict[str, str]:
    """The process answers."""
    return {"status": "live"}


@router.get("/readyz", responses=problems(503))
async def ready(edge: EdgeHere) -> dict[str, str]:
    """Redis and the blob store take writes, and a worker slot is alive; 503 says which does not hold."""
    error = await edge.not_ready()
    if error is not None:
        raise error
    return {"status": "ready"}


@router.get("/metrics", response_class=Response, responses={200: _METRICS, **problems(503)})
async def metrics(edge: EdgeHere) -> Response:
    """Metrics of this process and of all jobs."""
    text = exposition(edge.metrics, await edge.health.metrics(), await edge.health.slots())
    return Response(text, media_type=CONTENT_TYPE_LATEST)
