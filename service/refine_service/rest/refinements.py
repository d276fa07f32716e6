"""REST: the refinements. Events and artifacts are in events.py and artifacts.py."""

from __future__ import annotations

import re
from contextlib import aclosing
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import Response

from refine_jobs.record import Task
from refine_proto.errors import Conflict, NotReady, from_problem
from refine_proto.formats import ARTIFACTS, ArtifactName
from refine_proto.lists import Lifetime, make_filter, read_pairs
from refine_proto.models import Refinement, RefinementPage, State, Validation

from ..edge.artifacts import find_artifact
from ..edge.ask import ask
from ..edge.edge import COLLECTION, Edge, with_urls
from ..edge.follow import wait_for_end
from ..edge.submit import submit
from .artifacts import artifact_response
from .body import read_body
from .depends import CallHere, EdgeHere, Found
from .openapi import ACCEPTED, CREATE_BODY, FINISHED, problems
from .problems import problem_response

MAX_WAIT_S = 60
GLB = ARTIFACTS[ArtifactName.REFINED]
_JSON = re.compile(r"application/(json|\*)|\*/\*", re.IGNORECASE)
_WAIT = re.compile(r"(?:^|[,;\s])wait\s*=\s*\"?(\d{1,9})", re.IGNORECASE)

router = APIRouter(prefix=COLLECTION, tags=["refinements"])


@router.post(
    "",
    status_code=202,
    response_model=Refinement,
    responses={
        200: FINISHED,
        202: ACCEPTED,
        **problems(401, 403, 406, 409, 410, 413, 415, 422, 429, 500, 503, 504),
    },
    openapi_extra={"requestBody": CREATE_BODY},
)
async def create_refinement(
    request: Request,
    edge: EdgeHere,
    call: CallHere,
    prefer: Annotated[str, Header(description="`wait=N`: answer when done, N seconds at most (60).")] = "",
    accept: Annotated[
        str,
        Header(description=f"`{GLB}`: the refined mesh is the body; 406 if it is not ready in time (60 s)."),
    ] = "",
    idempotency_key: Annotated[
        str | None, Header(description="The same key with the same content gives the first answer again.")
    ] = None,
) -> Response:
    """Submit a mesh, its silhouette and the camera."""
    edge.check_not_draining()
    with edge.uploads.take(call.owner):
        async with aclosing(await read_body(request, edge.settings)) as upload:
            submitted = await submit(edge, call, upload, idempotency_key)
    refinement = with_urls(submitted.refinement)
    headers = {"Location": f"{COLLECTION}/{refinement.id}"}
    if submitted.replayed:
        headers["Idempotency-Replayed"] = "true"
    if wanted := _WAIT.search(prefer):
        headers["Preference-Applied"] = f"wait={min(int(wanted[1]), MAX_WAIT_S)}"
    if wanted or GLB in accept:  # who wants the mesh wants to wait for it
        wait_s = min(int(wanted[1]), MAX_WAIT_S) if wanted else MAX_WAIT_S
        refinement = await wait_for_end(edge, call.owner, refinement.id, wait_s)
        if GLB in accept and (refinement.state.terminal or not _JSON.search(accept)):
            return await _refined_mesh(edge, refinement, headers)
    status = 200 if wanted and refinement.state.terminal else 202
    return Response(refinement.model_dump_json(), status, headers, "application/json")


@router.post(
    ":validate",
    response_model=Validation,
    responses=problems(401, 403, 413, 415, 422, 429, 500, 503, 504),
    openapi_extra={"requestBody": CREATE_BODY},
)
async def validate_refinement(request: Request, edge: EdgeHere, call: CallHere) -> Validation:
    """Say what looks wrong with a mesh, its silhouette and the camera. Nothing is refined or kept."""
    edge.check_not_draining()
    with edge.uploads.take(call.owner):
        async with aclosing(await read_body(request, edge.settings)) as upload:
            return Validation.model_validate(await ask(edge, call, upload, Task.VALIDATE))


async def _refined_mesh(edge: Edge, refinement: Refinement, headers: dict[str, str]) -> Response:
    """The refined GLB itself; raises the refinement's error if there is none."""
    if refinement.state is State.SUCCEEDED:
        artifact = find_artifact(refinement, ArtifactName.REFINED)
        response = await artifact_response(edge, refinement, artifact)
        response.headers.update(headers)
        return response
    if refinement.error is not None:
        raise from_problem(refinement.error)
    if refinement.state.terminal:
        raise Conflict(f"refinement {refinement.id} is {refinement.state}; it has no refined mesh")
    # Answered with JSON and a status of success, it would end up in a file that is called .glb.
    error = NotReady(
        f"refinement {refinement.id} is {refinement.state} and goes on; wait for its end and get its "
        f"{ArtifactName.REFINED}, or send this again with the same Idempotency-Key, which waits again"
    )
    response = problem_response(error)
    response.headers.update(headers)
    return response


@router.get("", responses=problems(401, 403, 422, 429, 503))
async def list_refinements(
    edge: EdgeHere,
    call: CallHere,
    limit: Annotated[int, Query(ge=1, le=100)] = 20,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    state: Annotated[tuple[str, ...], Query(description="Those in one of these states.")] = (),
    metadata: Annotated[tuple[str, ...], Query(description="KEY=VALUE: those with all of these.")] = (),
) -> RefinementPage:
    """The caller's refinements, newest first. With a filter a page may be short: follow its cursor."""
    page = await edge.store.list(call.owner, limit, cursor, make_filter(state, read_pairs(metadata)))
    return page.model_copy(update={"refinements": [with_urls(item) for item in page.refinements]})


@router.get("/{refinement_id}", responses=problems(401, 403, 404, 410, 422, 429, 503))
async def get_refinement(refinement: Found) -> Refinement:
    """One refinement."""
    return refinement


@router.post(
    "/{refinement_id}/cancel",
    response_model=Refinement,
    responses={200: FINISHED, 202: ACCEPTED, **problems(401, 403, 404, 410, 422, 429, 503)},
)
async def cancel_refinement(refinement_id: str, edge: EdgeHere, call: CallHere) -> Response:
    """Queued: cancelled at once. Running: 202, `cancelling`, stops soon. Ended: unchanged."""
    call.job_id = refinement_id
    refinement = with_urls(await edge.store.cancel(call.owner, refinement_id))
    status = 200 if refinement.state.terminal else 202
    return Response(refinement.model_dump_json(), status, media_type="application/json")


@router.patch("/{refinement_id}", responses=problems(401, 403, 404, 409, 410, 422, 429, 503))
async def extend_refinement(
    refinement_id: str, lifetime: Lifetime, edge: EdgeHere, call: CallHere
) -> Refinement:
    """Keep an ended refinement and its bytes for `lifetime_s` from now on; 409 before its end."""
    call.job_id = refinement_id
    return with_urls(await edge.store.extend(call.owner, refinement_id, lifetime.lifetime_s))


@router.delete(
    "/{refinement_id}", status_code=204, responses=problems(401, 403, 404, 409, 410, 422, 429, 503)
)
async def delete_refinement(refinement_id: str, edge: EdgeHere, call: CallHere) -> None:
    """Remove the record and its bytes; 409 while it is running."""
    call.job_id = refinement_id
    await edge.store.delete(call.owner, refinement_id)
