"""What a transport does: one try of each call of the contract. Repeating is the business of the faces.

All raise the errors of `refine_proto.errors`, and ConnectionLost where there was no proper answer.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Generator
from typing import Protocol

from refine_proto.lists import Lifetime, RefinementFilter
from refine_proto.models import Artifact, CameraEstimate, Event, Refinement, RefinementPage, Validation

from ..address import Connection
from ..upload import Upload


class Transport(Protocol):
    def create(self, upload: Upload) -> Refinement: ...
    def validate(self, upload: Upload) -> Validation: ...
    def estimate_camera(self, upload: Upload) -> CameraEstimate: ...
    def get(self, refinement_id: str) -> Refinement: ...
    def list(self, limit: int | None, cursor: str | None, wanted: RefinementFilter) -> RefinementPage: ...
    def extend(self, refinement_id: str, lifetime: Lifetime) -> Refinement: ...
    def cancel(self, refinement_id: str) -> Refinement: ...
    def delete(self, refinement_id: str) -> None: ...

    def events(
        self, refinement_id: str, after_sequence: int, longest_s: float
    ) -> Generator[Event, None, None]:
        """The events after `after_sequence` from one connection of at most `longest_s`.

        Returns after the event `completed` or when the time is up, raises otherwise.
        """
        ...

    def download(self, refinement_id: str, artifact: Artifact, offset: int) -> Generator[bytes, None, None]:
        """The bytes of an artifact from `offset` on; DownloadCorrupt if the server now has other bytes."""
        ...

    def close(self) -> None: ...


class AsyncTransport(Protocol):
    """Transport for asyncio."""

    async def create(self, upload: Upload) -> Refinement: ...
    async def validate(self, upload: Upload) -> Validation: ...
    async def estimate_camera(self, upload: Upload) -> CameraEstimate: ...
    async def get(self, refinement_id: str) -> Refinement: ...
    async def list(
        self, limit: int | None, cursor: str | None, wanted: RefinementFilter
    ) -> RefinementPage: ...
    async def extend(self, refinement_id: str, lifetime: Lifetime) -> Refinement: ...
    async def cancel(self, refinement_id: str) -> Refinement: ...
    async def delete(self, refinement_id: str) -> None: ...
    def events(
        self, refinement_id: str, after_sequence: int, longest_s: float
    ) -> AsyncGenerator[Event, None]: ...
    def download(
        self, refinement_id: str, artifact: Artifact, offset: int
    ) -> AsyncGenerator[bytes, None]: ...
    async def close(self) -> None: ...


# Imported where needed: whoever speaks REST does not load grpc, and the other way round.


def make_transport(connection: Connection) -> Transport:
    if connection.grpc:
        from .grpc_transport import GrpcTransport

        return GrpcTransport(connection)
    from .rest import RestTransport

    return RestTransport(connection)


def make_async_transport(connection: Connection) -> AsyncTransport:
    if connection.grpc:
        from .grpc_transport import AsyncGrpcTransport

        return AsyncGrpcTransport(connection)
    from .rest import AsyncRestTransport

    return AsyncRestTransport(connection)
