"""gRPC: refine.v1.Refinements. The same calls as REST, on the same store, with the same answers."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

from google.protobuf.empty_pb2 import Empty

from refine_jobs.record import Task
from refine_proto.convert import to_message
from refine_proto.errors import InvalidInput, RangeNotSatisfiable
from refine_proto.lists import make_filter
from refine_proto.models import CameraEstimate, FieldError, Validation
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsServicer

from ..edge.artifacts import find_artifact, open_artifact
from ..edge.ask import ask, ask_for_camera
from ..edge.call import CALL, Call
from ..edge.edge import Edge, with_urls
from ..edge.follow import follow
from ..edge.submit import submit
from .body import read_messages
from .errors import RpcContext

CHUNK_BYTES = 64 * 1024
_LIST_LIMIT = 20
_MAX_LIST_LIMIT = 100


class Refinements(RefinementsServicer):
    """Every method runs inside middleware.RpcCalls, which signs in and turns errors into statuses."""

    def __init__(self, edge: Edge) -> None:
        self._edge = edge

    async def CreateRefinement(
        self, request_iterator: AsyncIterator[pb.CreateRefinementRequest], context: RpcContext
    ) -> pb.Refinement:
        """Header, then chunks."""
        edge, call = self._edge, CALL.get()
        edge.check_not_draining()
        with edge.uploads.take(call.owner):
            request_id, upload = await read_messages(request_iterator, edge.settings)
            async with aclosing(upload):
                submitted = await submit(edge, call, upload, request_id)
        if submitted.replayed:
            context.set_trailing_metadata((("idempotency-replayed", "true"),))
        return to_message(with_urls(submitted.refinement), pb.Refinement)

    async def ValidateRefinement(
        self, request_iterator: AsyncIterator[pb.CreateRefinementRequest], context: RpcContext
    ) -> pb.Validation:
        """Header, then chunks; its request id means nothing here."""
        edge = self._edge
        edge.check_not_draining()
        with edge.uploads.take(CALL.get().owner):
            _, upload = await read_messages(request_iterator, edge.settings)
            async with aclosing(upload):
                answer = await ask(edge, CALL.get(), upload, Task.VALIDATE)
        return to_message(Validation.model_validate(answer), pb.Validation)

    async def EstimateCamera(
        self, request_iterator: AsyncIterator[pb.CreateRefinementRequest], context: RpcContext
    ) -> pb.CameraEstimate:
        """Header, then chunks; its request id means nothing here."""
        edge = self._edge
        edge.check_not_draining()
        _, upload = await read_messages(request_iterator, edge.settings)
        async with aclosing(upload):
            answer = await ask_for_camera(edge, CALL.get(), upload)
        return to_message(CameraEstimate.model_validate(answer), pb.CameraEstimate)

    async def GetRefinement(self, request: pb.GetRefinementRequest, context: RpcContext) -> pb.Refinement:
        """One refinement."""
        call = self._call_about(request.id)
        return to_message(await self._edge.refinement(call.owner, request.id), pb.Refinement)

    async def ListRefinements(
        self, request: pb.ListRefinementsRequest, context: RpcContext
    ) -> pb.RefinementPage:
        """The caller's refinements, newest first."""
        limit = request.limit if request.HasField("limit") else _LIST_LIMIT
        if not 1 <= limit <= _MAX_LIST_LIMIT:
            raise _invalid("limit", f"expected a limit from 1 to {_MAX_LIST_LIMIT}, got {limit}")
        names = pb.Refinement.State.DESCRIPTOR.values_by_number
        states = [names[n].name.lower() if n in names else str(n) for n in request.state]
        wanted = make_filter(states, dict(request.metadata))
        page = await self._edge.store.list(CALL.get().owner, limit, request.cursor or None, wanted)
        shown = page.model_copy(update={"refinements": [with_urls(item) for item in page.refinements]})
        return to_message(shown, pb.RefinementPage)

    async def WatchRefinement(
        self, request: pb.WatchRefinementRequest, context: RpcContext
    ) -> AsyncGenerator[pb.Event, None]:
        """The events so far and to come; UNAVAILABLE when the server drains: watch again after the last."""
        call = self._call_about(request.id)
        if request.after_sequence < 0:
            raise _invalid("after_sequence", f"expected 0 or more, got {request.after_sequence}")
        with self._edge.watchers.take(call.owner), self._edge.metrics.watching("grpc"):
            events = follow(self._edge, call.owner, request.id, request.after_sequence)
            async with aclosing(events):
                async for event in events:
                    yield to_message(event, pb.Event)
                    if event.refinement is not None:
                        return
        self._edge.check_not_draining()

    async def CancelRefinement(
        self, request: pb.CancelRefinementRequest, context: RpcContext
    ) -> pb.Refinement:
        """Cancelled at once, cancelling, or unchanged."""
        call = self._call_about(request.id)
        return to_message(with_urls(await self._edge.store.cancel(call.owner, request.id)), pb.Refinement)

    async def ExtendRefinement(
        self, request: pb.ExtendRefinementRequest, context: RpcContext
    ) -> pb.Refinement:
        """Keep an ended refinement for longer, or shorter."""
        call = self._call_about(request.id)
        extended = await self._edge.store.extend(call.owner, request.id, request.lifetime_s)
        return to_message(with_urls(extended), pb.Refinement)

    async def DeleteRefinement(self, request: pb.DeleteRefinementRequest, context: RpcContext) -> Empty:
        """Remove record and bytes."""
        call = self._call_about(request.id)
        await self._edge.store.delete(call.owner, request.id)
        return Empty()

    async def DownloadArtifact(
        self, request: pb.DownloadArtifactRequest, context: RpcContext
    ) -> AsyncGenerator[pb.ArtifactChunk, None]:
        """The artifact's description, then its bytes from offset_bytes on."""
        call = self._call_about(request.id)
        refinement = await self._edge.refinement(call.owner, request.id)
        artifact = find_artifact(refinement, request.name)
        size, start = artifact.size_bytes, request.offset_bytes
        if not 0 <= start <= size:
            raise RangeNotSatisfiable(f"expected offset_bytes from 0 to {size}, got {start}")
        chunks = await open_artifact(self._edge, refinement, artifact, start, size)
        yield pb.ArtifactChunk(artifact=to_message(artifact, pb.Artifact))
        async for chunk in chunks:
            for at in range(0, len(chunk), CHUNK_BYTES):
                yield pb.ArtifactChunk(data=chunk[at : at + CHUNK_BYTES])

    def _call_about(self, refinement_id: str) -> Call:
        call = CALL.get()
        call.job_id = refinement_id
        return call


def _invalid(field: str, detail: str) -> InvalidInput:
    return InvalidInput(detail, errors=[FieldError(pointer=f"/{field}", detail=detail)])
