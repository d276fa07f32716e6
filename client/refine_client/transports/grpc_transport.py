"""gRPC over grpcio, for threads and for asyncio. What is sent and what it means is in `grpc_messages`."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Generator
from functools import cached_property
from typing import Any

import grpc
from google.protobuf.message import Message

from refine_proto.lists import Lifetime, RefinementFilter
from refine_proto.models import Artifact, CameraEstimate, Event, Refinement, RefinementPage, Validation
from refine_proto.v1 import refine_pb2
from refine_proto.v1.refine_pb2_grpc import RefinementsStub

from ..address import Connection
from ..upload import Upload
from . import grpc_messages


class GrpcTransport:
    """Implements `base.Transport`."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        if connection.tls:
            credentials = grpc.ssl_channel_credentials()
            self._channel = grpc.secure_channel(connection.target, credentials, grpc_messages.OPTIONS)
        else:
            self._channel = grpc.insecure_channel(connection.target, grpc_messages.OPTIONS)
        self._stub = RefinementsStub(self._channel)

    def create(self, upload: Upload) -> Refinement:
        with upload.opened() as files:
            deadline_s = grpc_messages.transfer_s(
                self._connection, sum(file.size_bytes for file in files.values())
            )
            message = self._call(self._stub.CreateRefinement, grpc_messages.create(upload, files), deadline_s)
        return grpc_messages.parse(message, Refinement)

    def validate(self, upload: Upload) -> Validation:
        with upload.opened() as files:
            deadline_s = grpc_messages.transfer_s(
                self._connection, sum(file.size_bytes for file in files.values())
            )
            message = self._call(
                self._stub.ValidateRefinement, grpc_messages.create(upload, files), deadline_s
            )
        return grpc_messages.parse(message, Validation)

    def estimate_camera(self, upload: Upload) -> CameraEstimate:
        with upload.opened() as files:
            deadline_s = grpc_messages.transfer_s(
                self._connection, sum(file.size_bytes for file in files.values())
            )
            message = self._call(self._stub.EstimateCamera, grpc_messages.create(upload, files), deadline_s)
        return grpc_messages.parse(message, CameraEstimate)

    def get(self, refinement_id: str) -> Refinement:
        request = refine_pb2.GetRefinementRequest(id=refinement_id)
        return grpc_messages.parse(self._call(self._stub.GetRefinement, request), Refinement)

    def list(self, limit: int | None, cursor: str | None, wanted: RefinementFilter) -> RefinementPage:
        request = grpc_messages.list_(limit, cursor, wanted)
        return grpc_messages.parse(self._call(self._stub.ListRefinements, request), RefinementPage)

    def extend(self, refinement_id: str, lifetime: Lifetime) -> Refinement:
        request = refine_pb2.ExtendRefinementRequest(id=refinement_id, lifetime_s=lifetime.lifetime_s)
        return grpc_messages.parse(self._call(self._stub.ExtendRefinement, request), Refinement)

    def cancel(self, refinement_id: str) -> Refinement:
        request = refine_pb2.CancelRefinementRequest(id=refinement_id)
        return grpc_messages.parse(self._call(self._stub.CancelRefinement, request), Refinement)

    def delete(self, refinement_id: str) -> None:
        self._call(self._stub.DeleteRefinement, refine_pb2.DeleteRefinementRequest(id=refinement_id))

    def events(
        self, refinement_id: str, after_sequence: int, longest_s: float
    ) -> Generator[Event, None, None]:
        request = refine_pb2.WatchRefinementRequest(id=refinement_id, after_sequence=after_sequence)
        return self._stream(self._stub.WatchRefinement, request, longest_s, grpc_messages.Events())

    def download(self, refinement_id: str, artifact: Artifact, offset: int) -> Generator[bytes, None, None]:
        request = refine_pb2.DownloadArtifactRequest(
            id=refinement_id, name=artifact.name, offset_bytes=offset
        )
        deadline_s = grpc_messages.transfer_s(self._connection, artifact.size_bytes - offset)
        return self._stream(self._stub.DownloadArtifact, request, deadline_s, grpc_messages.Chunks(artifact))

    def close(self) -> None:
        self._channel.close()

    def _call(self, method: Any, request: Any, deadline_s: float | None = None) -> Any:
        metadata = grpc_messages.metadata(self._connection)
        with grpc_messages.call_errors(self._connection, metadata):
            return method(request, timeout=deadline_s or self._connection.timeout_s, metadata=metadata)

    def _stream(
        self,
        method: Any,
        request: Message,
        deadline_s: float,
        reader: grpc_messages.Events | grpc_messages.Chunks,
    ) -> Generator[Any, None, None]:
        metadata = grpc_messages.metadata(self._connection)
        with grpc_messages.call_errors(self._connection, metadata, ends_at_deadline=reader.ends_at_deadline):
            call = method(request, timeout=deadline_s, metadata=metadata)
            try:
                for message in call:
                    if (found := reader.read(message)) is not None:
                        yield found
                    if reader.ended:
                        return
                reader.check_end()
            finally:
                call.cancel()


class AsyncGrpcTransport:
    """Implements `base.AsyncTransport`. The channel belongs to the event loop of the first call."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    @cached_property
    def _channel(self) -> grpc.aio.Channel:
        if self._connection.tls:
            credentials = grpc.ssl_channel_credentials()
            return grpc.aio.secure_channel(self._connection.target, credentials, grpc_messages.OPTIONS)
        return grpc.aio.insecure_channel(self._connection.target, grpc_messages.OPTIONS)

    @cached_property
    def _stub(self) -> Any:
        return RefinementsStub(self._channel)

    async def create(self, upload: Upload) -> Refinement:
        with upload.opened() as files:
            deadline_s = grpc_messages.transfer_s(
                self._connection, sum(file.size_bytes for file in files.values())
            )
            message = await self._call(
                self._stub.CreateRefinement, grpc_messages.create(upload, files), deadline_s
            )
        return grpc_messages.parse(message, Refinement)

    async def validate(self, upload: Upload) -> Validation:
        with upload.opened() as files:
            deadline_s = grpc_messages.transfer_s(
                self._connection, sum(file.size_bytes for file in files.values())
            )
            message = await self._call(
                self._stub.ValidateRefinement, grpc_messages.create(upload, files), deadline_s
            )
        return grpc_messages.parse(message, Validation)

    async def estimate_camera(self, upload: Upload) -> CameraEstimate:
        with upload.opened() as files:
            deadline_s = grpc_messages.transfer_s(
                self._connection, sum(file.size_bytes for file in files.values())
            )
            message = await self._call(
                self._stub.EstimateCamera, grpc_messages.create(upload, files), deadline_s
            )
        return grpc_messages.parse(message, CameraEstimate)

    async def get(self, refinement_id: str) -> Refinement:
        request = refine_pb2.GetRefinementRequest(id=refinement_id)
        return grpc_messages.parse(await self._call(self._stub.GetRefinement, request), Refinement)

    async def list(self, limit: int | None, cursor: str | None, wanted: RefinementFilter) -> RefinementPage:
        request = grpc_messages.list_(limit, cursor, wanted)
        return grpc_messages.parse(await self._call(self._stub.ListRefinements, request), RefinementPage)

    async def extend(self, refinement_id: str, lifetime: Lifetime) -> Refinement:
        request = refine_pb2.ExtendRefinementRequest(id=refinement_id, lifetime_s=lifetime.lifetime_s)
        return grpc_messages.parse(await self._call(self._stub.ExtendRefinement, request), Refinement)

    async def cancel(self, refinement_id: str) -> Refinement:
        request = refine_pb2.CancelRefinementRequest(id=refinement_id)
        return grpc_messages.parse(await self._call(self._stub.CancelRefinement, request), Refinement)

    async def delete(self, refinement_id: str) -> None:
        await self._call(self._stub.DeleteRefinement, refine_pb2.DeleteRefinementRequest(id=refinement_id))

    def events(
        self, refinement_id: str, after_sequence: int, longest_s: float
    ) -> AsyncGenerator[Event, None]:
        request = refine_pb2.WatchRefinementRequest(id=refinement_id, after_sequence=after_sequence)
        return self._stream(self._stub.WatchRefinement, request, longest_s, grpc_messages.Events())

    def download(self, refinement_id: str, artifact: Artifact, offset: int) -> AsyncGenerator[bytes, None]:
        request = refine_pb2.DownloadArtifactRequest(
            id=refinement_id, name=artifact.name, offset_bytes=offset
        )
        deadline_s = grpc_messages.transfer_s(self._connection, artifact.size_bytes - offset)
        return self._stream(self._stub.DownloadArtifact, request, deadline_s, grpc_messages.Chunks(artifact))

    async def close(self) -> None:
        if "_channel" in vars(self):
            await self._channel.close()

    async def _call(self, method: Any, request: Any, deadline_s: float | None = None) -> Any:
        metadata = grpc_messages.metadata(self._connection)
        with grpc_messages.call_errors(self._connection, metadata):
            return await method(request, timeout=deadline_s or self._connection.timeout_s, metadata=metadata)

    async def _stream(
        self,
        method: Any,
        request: Message,
        deadline_s: float,
        reader: grpc_messages.Events | grpc_messages.Chunks,
    ) -> AsyncGenerator[Any, None]:
        metadata = grpc_messages.metadata(self._connection)
        with grpc_messages.call_errors(self._connection, metadata, ends_at_deadline=reader.ends_at_deadline):
            call = method(request, timeout=deadline_s, metadata=metadata)
            try:
                async for message in call:
                    if (found := reader.read(message)) is not None:
                        yield found
                    if reader.ended:
                        return
                reader.check_end()
            finally:
                call.cancel()
