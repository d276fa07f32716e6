"""REST: what is said of cameras before a refinement."""

from __future__ import annotations

from contextlib import aclosing

from fastapi import APIRouter, Request

from refine_proto.models import CameraEstimate

from ..edge.ask import ask_for_camera
from .body import read_body
from .depends import CallHere, EdgeHere
from .openapi import CREATE_BODY, problems

router = APIRouter(prefix="/v1/cameras", tags=["cameras"])


@router.post(
    ":estimate",
    response_model=CameraEstimate,
    responses=problems(401, 413, 415, 422, 429, 500, 503, 504),
    openapi_extra={"requestBody": CREATE_BODY},
)
async def estimate_camera(request: Request, edge: EdgeHere, call: CallHere) -> CameraEstimate:
    """Say where the camera of type `estimate` may be that saw the silhouette. Nothing is refined or kept."""
    edge.check_not_draining()
    async with aclosing(await read_body(request, edge.settings)) as upload:
        return CameraEstimate.model_validate(await ask_for_camera(edge, call, upload))
