"""REST: the bytes of artifacts, whole or in part (RFC 9110 sections 13 and 14)."""

from __future__ import annotations

import re
from typing import Annotated

from fastapi import APIRouter, Header
from fastapi.responses import Response, StreamingResponse

from refine_proto.errors import RangeNotSatisfiable
from refine_proto.models import Artifact, Refinement

from ..edge.artifacts import find_artifact, open_artifact
from ..edge.edge import COLLECTION, Edge
from .depends import EdgeHere, Found
from .openapi import DESCRIBED, NOT_MODIFIED, PART, WHOLE, problems, without_content
from .problems import problem_response

_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{0,18})|-(\d{1,18}))")

IfNoneMatch = Annotated[str | None, Header(description="Answer 304 if the ETag is among these.")]
router = APIRouter(prefix=COLLECTION, tags=["artifacts"])


@router.get(
    "/{refinement_id}/artifacts/{name}",
    response_class=Response,
    responses={200: WHOLE, 206: PART, 304: NOT_MODIFIED, **problems(401, 403, 404, 410, 416, 422, 429, 503)},
)
async def download_artifact(
    refinement: Found,
    name: str,
    edge: EdgeHere,
    range: Annotated[
        str | None, Header(description="One range, `bytes=a-b`, `bytes=a-` or `bytes=-n`.")
    ] = None,
    if_none_match: IfNoneMatch = None,
    if_range: Annotated[str | None, Header(description="The range counts only for this ETag.")] = None,
) -> Response:
    """The bytes of an artifact; the ETag is their SHA-256."""
    artifact = find_artifact(refinement, name)
    if _matches(if_none_match, _etag(artifact)):
        return Response(status_code=304, headers=_headers(artifact))
    try:
        span = _span(range if if_range in (None, _etag(artifact)) else None, artifact.size_bytes)
    except RangeNotSatisfiable as error:
        response = problem_response(error)
        response.headers["Content-Range"] = f"bytes */{artifact.size_bytes}"
        return response
    return await artifact_response(edge, refinement, artifact, span)


@router.head(
    "/{refinement_id}/artifacts/{name}",
    response_class=Response,
    responses={
        200: DESCRIBED,
        304: NOT_MODIFIED,
        **without_content(problems(401, 403, 404, 410, 422, 429, 503)),
    },
)
async def describe_artifact(
    refinement: Found, name: str, edge: EdgeHere, if_none_match: IfNoneMatch = None
) -> Response:
    """The headers of an artifact: its size, its type, and as ETag the SHA-256 of its bytes."""
    artifact = find_artifact(refinement, name)
    if _matches(if_none_match, _etag(artifact)):
        return Response(status_code=304, headers=_headers(artifact))
    await open_artifact(edge, refinement, artifact, 0, 0)  # they are still there
    size = {"Content-Length": str(artifact.size_bytes)}
    return Response(headers=_headers(artifact) | size, media_type=artifact.media_type)


async def artifact_response(
    edge: Edge, refinement: Refinement, artifact: Artifact, span: tuple[int, int] | None = None
) -> Response:
    """The bytes of an artifact: all, or those from the first to before the second number of `span`."""
    size = artifact.size_bytes
    start, stop = span or (0, size)
    headers = _headers(artifact) | {"Content-Length": str(stop - start)}
    if span:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    chunks = await open_artifact(edge, refinement, artifact, start, stop)
    return StreamingResponse(chunks, 206 if span else 200, headers, artifact.media_type)


def _headers(artifact: Artifact) -> dict[str, str]:
    return {
        "ETag": _etag(artifact),
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, max-age=3600, immutable",
        "Content-Disposition": f'attachment; filename="{artifact.name}"',
    }


def _etag(artifact: Artifact) -> str:
    return f'"{artifact.sha256}"'


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


def _matches(header: str | None, etag: str) -> bool:
    tags = (tag.strip().removeprefix("W/") for tag in (header or "").split(","))
    return any(tag in (etag, "*") for tag in tags)
