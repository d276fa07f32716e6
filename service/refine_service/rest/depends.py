"""What routes depend on: the edge of the process, the call of the request, the refinement of the path."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPBearer

from refine_proto.models import Refinement

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
    the_edge(request).auth.sign_in(call, request.headers.get("authorization"))
    return call


CallHere = Annotated[Call, Depends(the_call)]


async def the_refinement(refinement_id: str, edge: EdgeHere, call: CallHere) -> Refinement:
    """The caller's refinement that the path names."""
    call.job_id = refinement_id
    return await edge.refinement(call.owner, refinement_id)


Found = Annotated[Refinement, Depends(the_refinement)]
