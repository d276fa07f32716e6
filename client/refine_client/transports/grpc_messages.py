"""gRPC without a channel: the messages of the calls, and what a failed call means."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import grpc
from google.protobuf.message import DecodeError, Message
from google.rpc import status_pb2
from pydantic import BaseModel, ValidationError

from refine_proto import errors
from refine_proto.convert import to_message, to_model
from refine_proto.errors import RefineError, ServerError
from refine_proto.formats import MESH, SILHOUETTE
from refine_proto.lists import RefinementFilter
from refine_proto.models import Artifact, Event, EventType
from refine_proto.status import STATUS_KEY, from_status
from refine_proto.tracing import current_traceparent
from refine_proto.v1 import refine_pb2

from ..address import Connection
from ..errors import ConnectionLost, DownloadCorrupt
from ..upload import OpenFile, Upload

ModelT = TypeVar("ModelT", bound=BaseModel)
REQUEST_ID = "x-request-id"
OPTIONS = (("grpc.enable_retries", 0), ("grpc.primary_user_agent", "refine-client"))  # retry.py repeats
SLOWEST_TRANSFER_BYTES_PER_S = 100_000
_LOST = ("UNAVAILABLE", "CANCELLED", "DEADLINE_EXCEEDED", "ABORTED")
_KNOWN_EVENTS = frozenset(refine_pb2.Event.Type.Value(name.upper()) for name in EventType)
# What a status without a reason of ours means: a proxy's, the library's, or another server's.
_ERROR_OF_CODE: Mapping[str, type[RefineError]] = {
    "INVALID_ARGUMENT": errors.InvalidInput,
    "NOT_FOUND": errors.NotFound,
    "PERMISSION_DENIED": errors.Unauthenticated,
    "RESOURCE_EXHAUSTED": errors.PayloadTooLarge,
    "UNAUTHENTICATED": errors.Unauthenticated,
    "UNIMPLEMENTED": errors.MethodNotAllowed,
}


def metadata(connection: Connection) -> tuple[tuple[str, str], ...]:
    """What goes with a call: its own request id, and the caller's key."""
    own = [(REQUEST_ID, uuid.uuid4().hex)]
    if connection.api_key:
        own.append(("authorization", f"Bearer {connection.api_key}"))
    if traceparent := current_traceparent():
        own.append(("traceparent", traceparent))
    return tuple(own)


def create(upload: Upload, files: Mapping[str, OpenFile]) -> Iterator[refine_pb2.CreateRefinementRequest]:
    """The header, then all files in chunks, read as they are sent."""
    request = refine_pb2.CreateRefinementRequest
    yield request(
        header=request.Header(
            request_id=upload.idempotency_key,
            spec=to_message(upload.spec, refine_pb2.RefinementSpec),
            mesh_bytes=files[MESH].size_bytes if MESH in files else None,
            silhouette_bytes=files[SILHOUETTE].size_bytes if SILHOUETTE in files else None,
            file_urls=upload.urls,
        )
    )
    for name, file in files.items():
        for chunk in file.chunks():
            if name == MESH:
                yield request(mesh_chunk=chunk)
            elif name == SILHOUETTE:
                yield request(silhouette_chunk=chunk)
            else:
                yield request(file_chunk=refine_pb2.FileChunk(part=name, data=chunk))


def list_(
    limit: int | None, cursor: str | None, wanted: RefinementFilter
) -> refine_pb2.ListRefinementsRequest:
    states = [state.upper() for state in wanted.state]
    return refine_pb2.ListRefinementsRequest(
        limit=limit, cursor=cursor, state=states, metadata=wanted.metadata
    )


def transfer_s(connection: Connection, size_bytes: int) -> float:
    """The deadline of a call that moves so many bytes."""
    return connection.timeout_s + size_bytes / SLOWEST_TRANSFER_BYTES_PER_S


def parse(message: Message, model: type[ModelT]) -> ModelT:
    """The answer of a call as the contract's value."""
    try:
        return to_model(message, model)
    except ValidationError as error:
        raise ServerError(
            f"expected a {model.__name__} from the server, got another: {error.errors()[0]['msg']}"
        ) from None


class Events:
    """Reads the answers of WatchRefinement; the deadline of the call is an end like any other."""

    ends_at_deadline = True

    def __init__(self) -> None:
        self.ended = False

    def read(self, message: refine_pb2.Event) -> Event | None:
        """The event; None for a type that only a newer server knows."""
        if message.type not in _KNOWN_EVENTS:
            return None
        event = parse(message, Event)
        self.ended = event.type is EventType.COMPLETED
        return event

    def check_end(self) -> None:
        raise ConnectionLost("expected events up to `completed`, got the end of the stream")


class Chunks:
    """Reads the answers of DownloadArtifact: the artifact, which must be the wanted one, then its bytes."""

    ends_at_deadline = False
    ended = False

    def __init__(self, artifact: Artifact) -> None:
        self._wanted = artifact
        self._announced = False

    def read(self, chunk: refine_pb2.ArtifactChunk) -> bytes:
        if chunk.WhichOneof("content") == "artifact":
            got = parse(chunk.artifact, Artifact)
            if got.sha256 != self._wanted.sha256:
                raise DownloadCorrupt(
                    f"expected {self._wanted.name} with sha256 {self._wanted.sha256}, got {got.sha256}"
                )
            self._announced = True
        elif not self._announced:
            raise DownloadCorrupt(f"expected the description of {self._wanted.name} first, got bytes")
        return chunk.data

    def check_end(self) -> None:
        return None  # whoever writes the bytes knows how many are missing


@contextmanager
def call_errors(
    connection: Connection, sent: Sequence[tuple[str, str]], *, ends_at_deadline: bool = False
) -> Iterator[None]:
    """Turns grpc's errors into those of the contract; `sent` is the call's metadata."""
    try:
        yield
    except grpc.RpcError as error:
        found = error_of(error, connection, dict(sent)[REQUEST_ID])
        timed_out = error.code() is grpc.StatusCode.DEADLINE_EXCEEDED and isinstance(found, ConnectionLost)
        if not (ends_at_deadline and timed_out):
            raise found from error
    except RefineError as error:
        error.request_id = error.request_id or dict(sent)[REQUEST_ID]
        raise


def error_of(rpc_error: Any, connection: Connection, request_id: str) -> RefineError:
    """The error that a failed call tells; `rpc_error` is a grpc.RpcError that is also a grpc.Call."""
    received = dict(rpc_error.trailing_metadata() or ())
    error = _error_of_details(received.get(STATUS_KEY))
    if error is None:
        error = _error_of_code(rpc_error, connection)
    error.request_id = error.request_id or received.get(REQUEST_ID) or request_id
    return error


def _error_of_details(serialized: bytes | None) -> RefineError | None:
    if serialized is None:
        return None
    try:
        return from_status(status_pb2.Status.FromString(serialized))
    except DecodeError:
        return None


def _error_of_code(rpc_error: Any, connection: Connection) -> RefineError:
    code, details = rpc_error.code().name, rpc_error.details() or "no details"
    if code in _LOST or "RST_STREAM" in details:
        return ConnectionLost(
            f"expected an answer from {connection.server}, got {code}: {details}; is the server running?"
        )
    return _ERROR_OF_CODE.get(code, ServerError)(
        f"expected an answer of a REFINE server from {connection.server}, got {code}: {details}"
    )
