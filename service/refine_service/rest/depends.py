"""What routes depend on: the edge of the process, the call of the request, the refinement of the path."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPBearer

from refine_proto.models import Refinement

from ..edge.auth import Scope
from ..edge.call import CALL, Call
from ..edge.edge import Edge

bearer = HTTPBearer(auto_error=False, description="An API key made with `refine keys add`.")


def the_edge(request: Request) -> Edge:
    """The edge of this process."""
    edge: Edge = request.app.state.edge
    return edge


EdgeHere = Annotated[Edge, Depends(the_edge)]


def the_call(request: Request, _: Annotated[object, Depends(bearer)]) -> Call:
    """The call of this request, signed in."""
    call = CALL.get()
    scope = Scope.READ if request.method in ("GET", "HEAD") else Scope.SUBMIT
    the_edge(request).auth.sign_in(call, request.headers.get("authorization"), scope)
    return call


def the_scraper(request: Request) -> None:
    """Who asks for metrics; with `metrics_need_key` only a key with the scope admin."""
    edge = the_edge(request)
    if edge.settings.metrics_need_key:
        edge.auth.sign_in(CALL.get(), request.headers.get("authorization"), Scope.ADMIN)


CallHere = Annotated[Call, Depends(the_call)]


async def the_refinement(refinement_id: str, edge: EdgeHere, call: CallHere) -> Refinement:
    """The caller's refinement that the path names."""
    call.job_id = refinement_id
    return await edge.refinement(call.owner, refinement_id)


Found = Annotated[Refinement, Depends(the_refinement)]
