"""gRPC around every service of the port: what a stranger may hold without a key, or without a message.

grpcio waits for the one message of a unary call before it runs any of our code, for ever if none comes. Every
method is served as a stream instead (on the wire they are the same), so that the wait is ours to bound.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing, nullcontext
from typing import Any

import grpc
from grpc_health.v1 import health

from refine_proto.errors import InvalidInput, RefineError, Unauthenticated, UploadTimeout

from ..edge.call import Call
from ..edge.edge import Edge
from ..edge.places import Places
from .errors import RpcContext, abort
from .middleware import SERVICE

_MESSAGE_S = 10.0  # for the one message of a unary call
_HEALTH_WATCHES = 64  # they need no key


class Admission(grpc.aio.ServerInterceptor):
    """The outermost interceptor."""

    def __init__(self, edge: Edge) -> None:
        self._edge = edge
        self._health_watches = Places("health watches", _HEALTH_WATCHES)

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """The handler of a method, as one of a stream that begins at once."""
        handler = await continuation(handler_call_details)
        if handler is None:
            return None
        service = str(handler_call_details.method).split("/")[1]
        is_stranger = service == SERVICE and not self._has_key(handler_call_details)
        watches_health = service == health.SERVICE_NAME and handler.response_streaming

        async def behaviour(requests: AsyncIterator[Any], context: RpcContext) -> None:
            try:
                with self._health_watches.take(service) if watches_health else nullcontext():
                    # The sign-in of a stranger fails before the request is looked at.
                    whole = handler.request_streaming or is_stranger
                    await _serve(handler, requests if whole else await _only(requests), context)
            except RefineError as error:
                await abort(context, error, Call.of({}).request_id)

        return grpc.stream_stream_rpc_method_handler(
            behaviour, handler.request_deserializer, handler.response_serializer
        )

    def _has_key(self, details: grpc.HandlerCallDetails) -> bool:
        found = [value for name, value in details.invocation_metadata or () if name == "authorization"]
        try:
            self._edge.auth.identify(str(found[-1]) if found else None)
        except Unauthenticated:
            return False
        return True


async def _only(requests: AsyncIterator[Any]) -> Any:
    try:
        async with asyncio.timeout(_MESSAGE_S):
            request = await anext(aiter(requests), None)
    except TimeoutError:
        raise UploadTimeout(f"expected the message of the call within {_MESSAGE_S:g} s, got none") from None
    if request is None:
        raise InvalidInput("expected one message, got none")
    return request


async def _serve(handler: Any, request: Any, context: RpcContext) -> None:
    """Whatever kind of method it is, write its responses."""
    kinds = (handler.stream_stream, handler.stream_unary, handler.unary_stream, handler.unary_unary)
    behaviour = next(kind for kind in kinds if kind is not None)
    if inspect.isasyncgenfunction(behaviour):
        async with aclosing(behaviour(request, context)) as responses:
            async for response in responses:
                await context.write(response)
        return
    response = await behaviour(request, context)
    if not handler.response_streaming:  # else it has written by itself
        await context.write(response)
