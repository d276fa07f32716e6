"""Errors as answers: RFC 9457 problem details over HTTP, google.rpc.Status with ErrorInfo over gRPC.

Both come from the one table in refine_proto.errors.
"""

from __future__ import annotations

import logging
import math
from typing import Any, TypeAlias

import grpc
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from refine_proto.errors import (
    Internal,
    InvalidInput,
    MethodNotAllowed,
    NotFound,
    RefineError,
    Unauthenticated,
    from_validation,
)
from refine_proto.status import STATUS_KEY, to_status

from .calls import CALL

RpcContext: TypeAlias = "grpc.aio.ServicerContext[Any, Any]"
MEDIA_TYPE = "application/problem+json"

log = logging.getLogger(__name__)


def as_refine_error(error: Exception) -> RefineError:
    """What the caller is told; what is none of its business is logged and becomes INTERNAL."""
    if isinstance(error, RefineError):
        return error
    if isinstance(error, RequestValidationError | ValidationError):
        return from_validation(error.errors())
    if isinstance(error, HTTPException):
        return _http_error(error)
    log.error("unexpected %s", type(error).__name__, exc_info=error)
    return Internal("an error of the server, not of the request; it is logged under the request id")


def _http_error(error: HTTPException) -> RefineError:
    match error.status_code:
        case 404:
            return NotFound("there is nothing at this address; /docs lists what there is")
        case 405:
            allowed = (error.headers or {}).get("Allow", "another method")
            return MethodNotAllowed(f"expected {allowed} at this address")
        case _:  # 400: a body that is no multipart body
            return InvalidInput(f"malformed request: {error.detail}")


# ---- REST ----


def problem_response(error: RefineError) -> Response:
    """The error as an HTTP response."""
    call = CALL.get(None)
    problem = error.problem(request_id=call.request_id if call else None)
    headers = {"Cache-Control": "no-store"}
    if error.retry_after_s is not None:
        headers["Retry-After"] = str(max(1, math.ceil(error.retry_after_s)))
    if isinstance(error, Unauthenticated):
        headers["WWW-Authenticate"] = "Bearer"
    return Response(
        problem.model_dump_json(), status_code=problem.status, headers=headers, media_type=MEDIA_TYPE
    )


def install_handlers(app: FastAPI) -> None:
    """Answer every error of every route with problem details."""

    async def answer(request: Request, error: Exception) -> Response:
        response = problem_response(as_refine_error(error))
        if isinstance(error, HTTPException) and error.headers:
            response.headers.update(error.headers)
        return response

    for kind in (RefineError, RequestValidationError, HTTPException, Exception):
        app.add_exception_handler(kind, answer)


# ---- gRPC ----


async def abort(context: RpcContext, error: RefineError, request_id: str) -> None:
    """End the call with the error; always raises."""
    status = to_status(error, request_id=request_id)
    code = grpc.StatusCode[error.status.grpc]
    await context.abort(code, error.detail, ((STATUS_KEY, status.SerializeToString()),))
