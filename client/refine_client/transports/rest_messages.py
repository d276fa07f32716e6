"""REST without a socket: what to send for a call, and what an answer means."""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from refine_proto import errors
from refine_proto.errors import InvalidInput, NotFound, RefineError, ServerError, from_problem
from refine_proto.formats import address_of
from refine_proto.lists import RefinementFilter
from refine_proto.models import Artifact, Event, EventType, ProblemDetails
from refine_proto.tracing import current_traceparent

from ..address import Connection
from ..errors import ConnectionLost, DownloadCorrupt
from ..upload import OpenFile, Upload
from .sse import ServerSentEvent

ModelT = TypeVar("ModelT", bound=BaseModel)
Part = tuple[str, tuple[str | None, Any, str]]
REQUEST_ID = "X-Request-Id"
QUIET_S = 45.0
"""An event stream without a byte for this long is dead: the server pings every 15 s."""
# What an answer that is no problem+json means: a proxy's, or another server's.
_ERROR_OF_STATUS: Mapping[int, type[RefineError]] = {
    401: errors.Unauthenticated,
    403: errors.Unauthenticated,
    404: errors.NotFound,
    405: errors.MethodNotAllowed,
    413: errors.PayloadTooLarge,
    429: errors.QuotaExceeded,
    502: errors.Unavailable,
    503: errors.Unavailable,
    504: errors.Unavailable,
}


@dataclass(frozen=True)
class Request:
    """One request but for the server's address and the caller's key."""

    method: str
    path: str
    params: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)

    def arguments(self, connection: Connection) -> dict[str, Any]:
        """The arguments of `httpx.Client.build_request`."""
        own = {REQUEST_ID: uuid.uuid4().hex, "Accept": "application/json", "Accept-Encoding": "identity"}
        if connection.api_key:
            own["Authorization"] = f"Bearer {connection.api_key}"
        if traceparent := current_traceparent():
            own["traceparent"] = traceparent
        return {
            "method": self.method,
            "url": connection.server + self.path,
            "params": dict(self.params),
            "headers": {**own, **self.headers},
        }


def create(upload: Upload) -> Request:
    return Request("POST", "/v1/refinements", headers={"Idempotency-Key": upload.idempotency_key})


def validate() -> Request:
    return Request("POST", "/v1/refinements:validate")


def estimate_camera() -> Request:
    return Request("POST", "/v1/cameras:estimate")


def parts(upload: Upload, files: Mapping[str, OpenFile]) -> list[Part]:
    """The multipart body: what is small first, so that a server can refuse before the files come."""
    spec = upload.spec.model_dump(mode="json", exclude_none=True)
    names = [name for name in ("camera", "options", "views", "webhook", "metadata") if spec.get(name)]
    fields = [(name, (None, json.dumps(spec[name]), "application/json")) for name in names]
    if upload.spec.mesh_format is not None:
        fields.append(("mesh_format", (None, str(upload.spec.mesh_format), "text/plain")))
    fields += [(address_of(name), (None, url, "text/plain")) for name, url in upload.urls.items()]
    sent = [(name, (file.name, file.stream, "application/octet-stream")) for name, file in files.items()]
    return [*fields, *sent]


def get(refinement_id: str) -> Request:
    return Request("GET", _path(refinement_id))


def list_(limit: int | None, cursor: str | None, wanted: RefinementFilter) -> Request:
    params: dict[str, str | Sequence[str] | None] = {
        "limit": None if limit is None else str(limit),
        "cursor": cursor,
        "state": wanted.state,
        "metadata": [f"{key}={value}" for key, value in wanted.metadata.items()],
    }
    return Request("GET", "/v1/refinements", {name: value for name, value in params.items() if value})


def extend(refinement_id: str) -> Request:
    return Request("PATCH", _path(refinement_id))


def cancel(refinement_id: str) -> Request:
    return Request("POST", _path(refinement_id, "cancel"))


def delete(refinement_id: str) -> Request:
    return Request("DELETE", _path(refinement_id))


def events(refinement_id: str, after_sequence: int) -> Request:
    headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
    if after_sequence:
        headers["Last-Event-ID"] = str(after_sequence)
    return Request("GET", _path(refinement_id, "events"), headers=headers)


def download(refinement_id: str, artifact: Artifact, offset: int) -> Request:
    headers = {"Accept": "*/*"}
    if offset:
        headers |= {"Range": f"bytes={offset}-", "If-Range": f'"{artifact.sha256}"'}
    return Request("GET", _path(refinement_id, "artifacts", artifact.name), headers=headers)


def _path(*steps: str) -> str:
    return "/".join(("/v1/refinements", *(quote(step, safe="") for step in steps)))


def parse(response: httpx.Response, model: type[ModelT]) -> ModelT:
    """The body of a successful answer."""
    try:
        return model.model_validate_json(response.content)
    except ValidationError:
        raise _not_ours(response, f"a {model.__name__}") from None


def parse_event(response: httpx.Response, event: ServerSentEvent) -> Event | None:
    """The event of a message of the stream; None for a type that only a newer server knows."""
    if event.event not in list(EventType):
        return None
    try:
        return Event.model_validate_json(event.data)
    except ValidationError as error:
        raise ServerError(
            f"expected an Event from the server, got {event.data[:200]!r}: {error.errors()[0]['msg']}",
            request_id=request_id_of(response),
        ) from None


def skip_of(response: httpx.Response, artifact: Artifact, offset: int) -> int:
    """How many bytes of a download's body come before `offset`; DownloadCorrupt if it is of other bytes."""
    tag = response.headers.get("ETag", "").removeprefix("W/").strip('"')
    if tag != artifact.sha256:
        raise DownloadCorrupt(
            f"expected {artifact.name} with ETag {artifact.sha256}, got {tag or 'none'}",
            request_id=request_id_of(response),
        )
    if response.status_code != httpx.codes.PARTIAL_CONTENT:
        return offset
    sent = response.headers.get("Content-Range", "")
    if not sent.startswith(f"bytes {offset}-"):
        raise DownloadCorrupt(
            f"expected {artifact.name} from byte {offset} on, got Content-Range {sent!r}",
            request_id=request_id_of(response),
        )
    return 0


def check_stream(response: httpx.Response, media_type: str) -> None:
    got = response.headers.get("Content-Type", "none")
    if got.partition(";")[0].strip() != media_type:
        raise _not_ours(response, f"a stream of {media_type}")


def error_of(response: httpx.Response) -> RefineError:
    """The error that an answer of status 300 and above tells; its body must have been read."""
    retry_after_s = _retry_after_s(response.headers.get("Retry-After"))
    try:
        problem = ProblemDetails.model_validate_json(response.content)
    except ValidationError:
        return _error_of_status(response, retry_after_s)
    error = from_problem(problem, retry_after_s=retry_after_s)
    error.request_id = error.request_id or request_id_of(response)
    return error


def _error_of_status(response: httpx.Response, retry_after_s: float | None) -> RefineError:
    status = response.status_code
    fallback = ServerError if status >= 500 else InvalidInput if status >= 400 else NotFound  # 3xx
    detail = (
        f"expected an answer of a REFINE server from {response.request.url}, got "
        f"{status} {response.reason_phrase} without a reason; check the server's address and its proxies"
    )
    return _ERROR_OF_STATUS.get(status, fallback)(
        detail, retry_after_s=retry_after_s, request_id=request_id_of(response)
    )


def _not_ours(response: httpx.Response, wanted: str) -> RefineError:
    got = response.headers.get("Content-Type", "no content type")
    return ServerError(
        f"expected {wanted} from {response.request.url}, got {response.status_code} {got}; "
        "is this a REFINE server?",
        request_id=request_id_of(response),
    )


def request_id_of(response: httpx.Response) -> str:
    """The server's id of the request; ours if it told none."""
    return str(response.headers.get(REQUEST_ID) or response.request.headers[REQUEST_ID])


def _retry_after_s(value: str | None) -> float | None:
    """Seconds or a date, RFC 9110 section 10.2.3."""
    if value is None:
        return None
    try:
        seconds = float(value)
    except ValueError:
        try:
            seconds = (parsedate_to_datetime(value) - datetime.now(UTC)).total_seconds()
        except (ValueError, TypeError):
            return None
    return max(0.0, seconds) if math.isfinite(seconds) else None


@contextmanager
def connection_errors(request: httpx.Request) -> Iterator[None]:
    """Turns httpx's errors of a connection into ConnectionLost."""
    try:
        yield
    except httpx.TransportError as error:
        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        url = request.url.copy_with(query=None)
        raise ConnectionLost(
            f"expected an answer from {url}, got {what}; is the server running?",
            request_id=request.headers[REQUEST_ID],
        ) from error
