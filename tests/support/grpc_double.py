"""`server_double.Script` over gRPC."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NoReturn, TypeVar

import grpc
from google.protobuf.empty_pb2 import Empty
from server_double import Call, Script

from refine_proto.convert import to_message, to_model
from refine_proto.errors import RefineError
from refine_proto.models import RefinementSpec
from refine_proto.status import STATUS_KEY, to_status
from refine_proto.v1 import refine_pb2
from refine_proto.v1.refine_pb2_grpc import RefinementsServicer, add_RefinementsServicer_to_server

T = TypeVar("T")


class _Servicer(RefinementsServicer):
    def __init__(self, script: Script) -> None:
        self._script = script

    def CreateRefinement(self, requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
        key, upload = self._upload(requests)
        created = self._run(context, "create", lambda: self._script.create(key, upload), key)
        return to_message(created, refine_pb2.Refinement)

    def ValidateRefinement(self, requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
        _, upload = self._upload(requests)
        found = self._run(context, "validate", lambda: self._script.validation("", upload))
        return to_message(found, refine_pb2.Validation)

    def EstimateCamera(self, requests: Iterator[Any], context: grpc.ServicerContext) -> Any:
        _, upload = self._upload(requests)
        found = self._run(context, "estimate", lambda: self._script.estimate("", upload))
        return to_message(found, refine_pb2.CameraEstimate)

    def _upload(self, requests: Iterator[Any]) -> tuple[str, dict[str, Any]]:
        header = next(requests).header
        upload: dict[str, Any] = {"chunks": []}
        for request in requests:
            part = request.WhichOneof("part")
            chunk = getattr(request, part)
            name, data = (chunk.part, chunk.data) if part == "file_chunk" else (part[: -len("_chunk")], chunk)
            upload.setdefault(name, bytearray()).extend(data)
            upload["chunks"].append(len(data))
        upload |= to_model(header.spec, RefinementSpec).model_dump(mode="json", exclude_none=True)
        upload |= {f"{name}_url": url for name, url in header.file_urls.items()}
        upload["announced"] = (header.mesh_bytes, header.silhouette_bytes)
        return header.request_id, upload

    def GetRefinement(self, request: Any, context: grpc.ServicerContext) -> Any:
        found = self._run(context, "get", lambda: self._script.get(request.id))
        return to_message(found, refine_pb2.Refinement)

    def ListRefinements(self, request: Any, context: grpc.ServicerContext) -> Any:
        limit = request.limit if request.HasField("limit") else None
        cursor = request.cursor if request.HasField("cursor") else None
        page = self._run(context, "list", lambda: self._script.page(limit, cursor))
        return to_message(page, refine_pb2.RefinementPage)

    def CancelRefinement(self, request: Any, context: grpc.ServicerContext) -> Any:
        self._run(context, "cancel", self._script.cancelled.set)
        return to_message(self._script.refinement(), refine_pb2.Refinement)

    def DeleteRefinement(self, request: Any, context: grpc.ServicerContext) -> Any:
        self._run(context, "delete", lambda: self._script.delete(request.id))
        return Empty()

    def WatchRefinement(self, request: Any, context: grpc.ServicerContext) -> Iterator[Any]:
        self._run(context, "watch", lambda: None, request.after_sequence)
        if self._script.newer:
            yield refine_pb2.Event.FromString(b"\x10\x63\x20\x62")  # type = 99, state = 98
        for event in self._script.events(request.after_sequence):
            yield to_message(event, refine_pb2.Event)

    def DownloadArtifact(self, request: Any, context: grpc.ServicerContext) -> Iterator[Any]:
        self._run(context, "download", lambda: None, request.offset_bytes)
        artifact = next(a for a in self._script.refinement().artifacts if a.name == request.name)
        yield refine_pb2.ArtifactChunk(artifact=to_message(artifact, refine_pb2.Artifact))
        for portion in self._script.download(request.name, request.offset_bytes):
            yield refine_pb2.ArtifactChunk(data=portion)

    def _run(self, context: grpc.ServicerContext, name: str, act: Callable[[], T], detail: Any = None) -> T:
        metadata = dict(context.invocation_metadata())
        sender = metadata.get("authorization")
        call = Call(name, str(metadata["x-request-id"]), str(sender) if sender else None, detail)
        try:
            self._script.enter(call)
            return act()
        except RefineError as error:
            _abort(context, error, call.request_id)


def _abort(context: grpc.ServicerContext, error: RefineError, request_id: str) -> NoReturn:
    status = to_status(error, request_id=request_id)
    context.set_trailing_metadata(((STATUS_KEY, status.SerializeToString()),))
    context.abort(grpc.StatusCode[error.status.grpc], error.detail)


class GrpcDouble:
    """Serves a script until closed."""

    def __init__(self, script: Script) -> None:
        self._server = grpc.server(ThreadPoolExecutor(8))
        add_RefinementsServicer_to_server(_Servicer(script), self._server)
        self.port: int = self._server.add_insecure_port("127.0.0.1:0")
        self._server.start()

    def close(self) -> None:
        self._server.stop(None).wait()
