"""REST: the bytes of artifacts, whole or in part (RFC 9110 sections 13 and 14)."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import APIRouter, Header, Request
from fastapi.responses import Response, StreamingResponse
from starlette.datastructures import Headers

from refine_proto.errors import RangeNotSatisfiable
from refine_proto.models import Artifact, Refinement

from ..edge.artifacts import find_artifact, open_artifact
from ..edge.edge import COLLECTION, Edge
from .depends import EdgeHere, Found
from .openapi import NOT_MODIFIED, PART, WHOLE, problems
from .problems import problem_response

_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{0,18})|-(\d{1,18}))")

router = APIRouter(prefix=COLLECTION, tags=["artifacts"])


@router.get(
    "/{refinement_id}/artifacts/{name}",
    response_class=Response,
    responses={200: WHOLE, 206: PART, 304: NOT_MODIFIED, **problems(401, 404, 410, 416, 422, 429, 503)},
)
async def download_artifact(
    request: Request,
    refinement: Found,
    name: str,
    edge: EdgeHere,
    range: Annotated[
        str | None, Header(description="One range, `bytes=a-b`, `bytes=a-` or `bytes=-n`.")
    ] = None,
    if_none_match: Annotated[str | None, Header(description="Answer 304 if the ETag is among these.")] = None,
    if_range: Annotated[str | None, Header(description="The range counts only for this ETag.")] = None,
) -> Response:
    """The bytes of an artifact; the ETag is their SHA-256."""
    return await artifact_response(edge, request.headers, refinement, name)


async def artifact_response(
    edge: Edge, headers: Headers, refinement: Refinement, name: str, whole: bool = False
) -> Response:
    """What the request's headers ask for of an artifact; `whole`: all of it."""
    artifact = find_artifact(refinement, name)
    etag = f'"{artifact.sha256}"'
    answer = {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, max-age=3600, immutable",
        "Content-Disposition": f'attachment; filename="{artifact.name}"',
    }
    if whole:
        return await _part(edge, refinement, artifact, None, answer)
    if _matches(headers.get("if-none-match", ""), etag):
        return Response(status_code=304, headers=answer)
    wanted = headers.get("range") if headers.get("if-range", etag) == etag else None
    try:
        span = _span(wanted, artifact.size_bytes)
    except RangeNotSatisfiable as error:
        response = problem_response(error)
        response.headers["Content-Range"] = f"bytes */{artifact.size_bytes}"
        return response
    return await _part(edge, refinement, artifact, span, answer)


async def _part(
    edge: Edge,
    refinement: Refinement,
    artifact: Artifact,
    span: tuple[int, int] | None,
    headers: dict[str, str],
) -> Response:
    size = artifact.size_bytes
    start, stop = span or (0, size)
    headers["Content-Length"] = str(stop - start)
    if span:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    chunks = await open_artifact(edge, refinement, artifact, start, stop)
    return StreamingResponse(chunks, 206 if span else 200, headers, artifact.media_type)


def _span(header: str | None, size: int) -> tuple[int, int] | None:
    """The range [start, stop) asked for; None for all: several ranges and what is no range are ignored."""
    asked = _RANGE.fullmatch((header or "").strip())
    if asked is None:
        return None
    first, last, suffix = asked.groups()
    start = max(0, size - int(suffix)) if suffix else int(first)
    stop = min(size, int(last) + 1) if last else size
    if last and int(last) < int(first):
        return None  # not a range: ignored, says RFC 9110 section 14.1.1
    if start >= size or suffix == "0":
        raise RangeNotSatisfiable(f"expected a range within {size} bytes, got {header}")
    return start, stop


def _matches(header: str, etag: str) -> bool:
    tags = (tag.strip().removeprefix("W/") for tag in header.split(","))
    return any(tag in (etag, "*") for tag in tags)
