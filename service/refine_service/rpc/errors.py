"""Errors as answers over gRPC: google.rpc.Status with ErrorInfo, from the table in refine_proto.errors."""

from __future__ import annotations

from typing import Any, TypeAlias

import grpc

from refine_proto.errors import RefineError
from refine_proto.status import STATUS_KEY, to_status

RpcContext: TypeAlias = "grpc.aio.ServicerContext[Any, Any]"


async def abort(context: RpcContext, error: RefineError, request_id: str) -> None:
    """End the call with the error; always raises."""
    status = to_status(error, request_id=request_id)
    code = grpc.StatusCode[error.status.grpc]
    await context.abort(code, error.detail, ((STATUS_KEY, status.SerializeToString()),))
