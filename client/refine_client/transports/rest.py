"""REST over httpx, for threads and for asyncio. What is sent and what it means is in `rest_messages`."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Generator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any, NoReturn

import httpx

from refine_proto.lists import Lifetime, RefinementFilter
from refine_proto.models import (
    Artifact,
    CameraEstimate,
    Event,
    EventType,
    Refinement,
    RefinementPage,
    Validation,
)

from ..address import Connection
from ..errors import ConnectionLost
from ..upload import Upload
from . import rest_messages
from .sse import SseParser


class RestTransport:
    """Implements `base.Transport`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._client = httpx.Client(timeout=connection.timeout_s)

    def create(self, upload: Upload) -> Refinement:
        with upload.opened() as files:
            response = self._send(rest_messages.create(upload), files=rest_messages.parts(upload, files))
        return rest_messages.parse(response, Refinement)

    def validate(self, upload: Upload) -> Validation:
        with upload.opened() as files:
            response = self._send(rest_messages.validate(), files=rest_messages.parts(upload, files))
        return rest_messages.parse(response, Validation)

    def estimate_camera(self, upload: Upload) -> CameraEstimate:
        with upload.opened() as files:
            request, parts = rest_messages.estimate_camera(), rest_messages.parts(upload, files)
            response = self._send(request, files=parts)
        return rest_messages.parse(response, CameraEstimate)

    def get(self, refinement_id: str) -> Refinement:
        return rest_messages.parse(self._send(rest_messages.get(refinement_id)), Refinement)

    def list(self, limit: int | None, cursor: str | None, wanted: RefinementFilter) -> RefinementPage:
        response = self._send(rest_messages.list_(limit, cursor, wanted))
        return rest_messages.parse(response, RefinementPage)

    def extend(self, refinement_id: str, lifetime: Lifetime) -> Refinement:
        return rest_messages.parse(
            self._send(rest_messages.extend(refinement_id), json=lifetime.model_dump()), Refinement
        )

    def cancel(self, refinement_id: str) -> Refinement:
        return rest_messages.parse(self._send(rest_messages.cancel(refinement_id)), Refinement)

    def delete(self, refinement_id: str) -> None:
        self._send(rest_messages.delete(refinement_id))

    def events(
        self, refinement_id: str, after_sequence: int, longest_s: float
    ) -> Generator[Event, None, None]:
        stream = _EventStream(self._connection, longest_s)
        request = rest_messages.events(refinement_id, after_sequence)
        try:
            with self._stream(request, timeout=stream.timeout) as response:
                rest_messages.check_stream(response, "text/event-stream")
                for portion in response.iter_raw():
                    yield from stream.feed(response, portion)
                    if stream.ended:
                        return
                stream.cut_off()
        except ConnectionLost as error:
            stream.check_lost(error)

    def download(self, refinement_id: str, artifact: Artifact, offset: int) -> Generator[bytes, None, None]:
        with self._stream(rest_messages.download(refinement_id, artifact, offset)) as response:
            skip = rest_messages.skip_of(response, artifact, offset)
            for chunk in response.iter_raw():
                yield chunk[skip:]
                skip = max(0, skip - len(chunk))

    def close(self) -> None:
        self._client.close()

    def _send(self, request: rest_messages.Request, **more: Any) -> httpx.Response:
        built = self._client.build_request(**request.arguments(self._connection), **more)
        with rest_messages.connection_errors(built):
            response = self._client.send(built)
        if not response.is_success:
            raise rest_messages.error_of(response)
        return response

    @contextmanager
    def _stream(self, request: rest_messages.Request, **more: Any) -> Iterator[httpx.Response]:
        """An answer of which the body is still to come."""
        built = self._client.build_request(**request.arguments(self._connection), **more)
        with rest_messages.connection_errors(built):
            response = self._client.send(built, stream=True)
            try:
                if not response.is_success:
                    response.read()
                    raise rest_messages.error_of(response)
                yield response
            finally:
                response.close()


class AsyncRestTransport:
    """Implements `base.AsyncTransport`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._client = httpx.AsyncClient(timeout=connection.timeout_s)

    async def create(self, upload: Upload) -> Refinement:
        with upload.opened() as files:
            response = await self._send(
                rest_messages.create(upload), files=rest_messages.parts(upload, files)
            )
        return rest_messages.parse(response, Refinement)

    async def validate(self, upload: Upload) -> Validation:
        with upload.opened() as files:
            response = await self._send(rest_messages.validate(), files=rest_messages.parts(upload, files))
        return rest_messages.parse(response, Validation)

    async def estimate_camera(self, upload: Upload) -> CameraEstimate:
        with upload.opened() as files:
            request, parts = rest_messages.estimate_camera(), rest_messages.parts(upload, files)
            response = await self._send(request, files=parts)
        return rest_messages.parse(response, CameraEstimate)

    async def get(self, refinement_id: str) -> Refinement:
        return rest_messages.parse(await self._send(rest_messages.get(refinement_id)), Refinement)

    async def list(self, limit: int | None, cursor: str | None, wanted: RefinementFilter) -> RefinementPage:
        response = await self._send(rest_messages.list_(limit, cursor, wanted))
        return rest_messages.parse(response, RefinementPage)

    async def extend(self, refinement_id: str, lifetime: Lifetime) -> Refinement:
        return rest_messages.parse(
            await self._send(rest_messages.extend(refinement_id), json=lifetime.model_dump()), Refinement
        )

    async def cancel(self, refinement_id: str) -> Refinement:
        return rest_messages.parse(await self._send(rest_messages.cancel(refinement_id)), Refinement)

    async def delete(self, refinement_id: str) -> None:
        await self._send(rest_messages.delete(refinement_id))

    async def events(
        self, refinement_id: str, after_sequence: int, longest_s: float
    ) -> AsyncGenerator[Event, None]:
        stream = _EventStream(self._connection, longest_s)
        request = rest_messages.events(refinement_id, after_sequence)
        try:
            async with self._stream(request, timeout=stream.timeout) as response:
                rest_messages.check_stream(response, "text/event-stream")
                async for portion in response.aiter_raw():
                    for event in stream.feed(response, portion):
                        yield event
                    if stream.ended:
                        return
                stream.cut_off()
        except ConnectionLost as error:
            stream.check_lost(error)

    async def download(
        self, refinement_id: str, artifact: Artifact, offset: int
    ) -> AsyncGenerator[bytes, None]:
        async with self._stream(rest_messages.download(refinement_id, artifact, offset)) as response:
            skip = rest_messages.skip_of(response, artifact, offset)
            async for chunk in response.aiter_raw():
                yield chunk[skip:]
                skip = max(0, skip - len(chunk))

    async def close(self) -> None:
        await self._client.aclose()

    async def _send(self, request: rest_messages.Request, **more: Any) -> httpx.Response:
        built = self._client.build_request(**request.arguments(self._connection), **more)
        with rest_messages.connection_errors(built):
            response = await self._client.send(built)
        if not response.is_success:
            raise rest_messages.error_of(response)
        return response

    @asynccontextmanager
    async def _stream(self, request: rest_messages.Request, **more: Any) -> AsyncIterator[httpx.Response]:
        built = self._client.build_request(**request.arguments(self._connection), **more)
        with rest_messages.connection_errors(built):
            response = await self._client.send(built, stream=True)
            try:
                if not response.is_success:
                    await response.aread()
                    raise rest_messages.error_of(response)
                yield response
            finally:
                await response.aclose()


class _EventStream:
    """One connection that follows a refinement: its parser, and when it is over."""

    def __init__(self, connection: Connection, longest_s: float) -> None:
        self._parser = SseParser()
        self._longest_s = longest_s
        self._started = time.monotonic()
        self.timeout = httpx.Timeout(connection.timeout_s, read=min(rest_messages.QUIET_S, longest_s))
        self.ended = False

    def feed(self, response: httpx.Response, portion: bytes) -> Iterator[Event]:
        try:
            for message in self._parser.feed(portion):
                event = rest_messages.parse_event(response, message)
                if event is not None:
                    self.ended = self.ended or event.type is EventType.COMPLETED
                    yield event
        except ValueError as error:
            raise httpx.RemoteProtocolError(str(error)) from error
        # httpx bounds one read, not all of them: the other half is for a connection with a shorter bound.
        self.ended = self.ended or self._elapsed_s() > self._longest_s / 2

    def cut_off(self) -> NoReturn:
        raise httpx.RemoteProtocolError("the event stream ended before the event `completed`")

    def check_lost(self, error: ConnectionLost) -> None:
        """Raise `error`, unless it only says that the time is up."""
        if not (isinstance(error.__cause__, httpx.ReadTimeout) and self._elapsed_s() >= self._longest_s):
            raise error

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._started
