"""gRPC around the methods: sign-in, the Call, errors as statuses, log lines and metrics."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import aclosing, asynccontextmanager
from typing import Any, TypeAlias

import grpc

from refine_jobs.logs import fields
from refine_proto.tracing import Kind, start_span
from refine_proto.v1 import refine_pb2

from ..edge.auth import Scope
from ..edge.call import begin_call
from ..edge.edge import Edge
from ..edge.errors import as_refine_error
from .errors import RpcContext, abort

SERVICE = refine_pb2.DESCRIPTOR.services_by_name["Refinements"].full_name
_READING = ("Get", "List", "Watch", "Download")  # how the names of methods begin that change nothing
_Unary: TypeAlias = Callable[..., Awaitable[Any]]
_Stream: TypeAlias = Callable[..., AsyncGenerator[Any, None]]
_ERRORS_OF_THE_SERVER = ("INTERNAL", "UNAVAILABLE", "DEADLINE_EXCEEDED", "UNKNOWN", "UNIMPLEMENTED")
log = logging.getLogger(__name__)


class RpcCalls(grpc.aio.ServerInterceptor):
    """Wraps the methods of our service; health checks and reflection pass."""

    def __init__(self, edge: Edge) -> None:
        self._edge = edge

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """The handler of a method, wrapped."""
        handler = await continuation(handler_call_details)
        service, _, method = str(handler_call_details.method).removeprefix("/").partition("/")
        if handler is None or service != SERVICE:
            return handler
        codec = (handler.request_deserializer, handler.response_serializer)
        if handler.response_streaming:
            return grpc.unary_stream_rpc_method_handler(self._stream(method, handler.unary_stream), *codec)
        if handler.request_streaming:
            return grpc.stream_unary_rpc_method_handler(self._unary(method, handler.stream_unary), *codec)
        return grpc.unary_unary_rpc_method_handler(self._unary(method, handler.unary_unary), *codec)

    def _unary(self, method: str, behaviour: _Unary) -> _Unary:
        async def wrapped(request: Any, context: RpcContext) -> Any:
            async with self._call(method, context):
                response = await behaviour(self._counted(request), context)
                self._edge.metrics.count_bytes("grpc", sent=response.ByteSize())
                return response

        return wrapped

    def _stream(self, method: str, behaviour: _Stream) -> _Stream:
        async def wrapped(request: Any, context: RpcContext) -> AsyncGenerator[Any, None]:
            responses = behaviour(self._counted(request), context)
            async with self._call(method, context), aclosing(responses):
                async for response in responses:
                    self._edge.metrics.count_bytes("grpc", sent=response.ByteSize())
                    yield response

        return wrapped

    def _counted(self, request: Any) -> Any:
        """The request, its bytes counted: now, or as its messages come."""

        async def stream() -> AsyncIterator[Any]:
            async for message in request:
                self._edge.metrics.count_bytes("grpc", received=message.ByteSize())
                yield message

        if hasattr(request, "ByteSize"):
            self._edge.metrics.count_bytes("grpc", received=request.ByteSize())
            return request
        return stream()

    @asynccontextmanager
    async def _call(self, method: str, context: RpcContext) -> AsyncIterator[None]:
        metadata = {
            name: value for name, value in context.invocation_metadata() or () if isinstance(value, str)
        }
        call = begin_call(metadata)
        started, status = time.perf_counter(), "OK"
        attributes = {"rpc.system": "grpc", "rpc.service": SERVICE, "rpc.method": method}
        work = start_span(f"{SERVICE}/{method}", Kind.SERVER, call.traceparent, attributes)
        call.traceparent = work.traceparent or call.traceparent
        try:
            await context.send_initial_metadata((("x-request-id", call.request_id),))
            scope = Scope.READ if method.startswith(_READING) else Scope.SUBMIT
            self._edge.auth.sign_in(call, metadata.get("authorization"), scope)
            yield
        except (asyncio.CancelledError, GeneratorExit):
            status = "CANCELLED"  # the caller has gone, or its deadline has passed
            raise
        except Exception as error:
            told = as_refine_error(error)
            status = told.status.grpc
            await abort(context, told, call.request_id)
        finally:
            seconds = time.perf_counter() - started
            work.set({"rpc.response.status_code": status})
            if status in _ERRORS_OF_THE_SERVER:
                work.fail(status)
            work.end()
            self._edge.metrics.observe("grpc", method, status, seconds)
            values = fields(method=method, status=status, seconds=round(seconds, 4), owner=call.owner)
            log.info("%s %s", method, status, extra=values)
