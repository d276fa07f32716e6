"""Errors as answers over HTTP: RFC 9457 problem details, from the one table in refine_proto.errors."""

from __future__ import annotations

import math

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException

from refine_proto.errors import (
    InvalidInput,
    MethodNotAllowed,
    NotFound,
    RefineError,
    Unauthenticated,
    from_validation,
)

from ..edge.call import CALL
from ..edge.errors import as_refine_error

MEDIA_TYPE = "application/problem+json"


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
        response = problem_response(_told(error))
        if isinstance(error, HTTPException) and error.headers:
            response.headers.update(error.headers)
        return response

    for kind in (RefineError, RequestValidationError, HTTPException, Exception):
        app.add_exception_handler(kind, answer)


def _told(error: Exception) -> RefineError:
    match error:
        case RequestValidationError():
            return from_validation(error.errors())
        case HTTPException(status_code=404):
            return NotFound("there is nothing at this address; /docs lists what there is")
        case HTTPException(status_code=405):
            allowed = (error.headers or {}).get("Allow", "another method")
            return MethodNotAllowed(f"expected {allowed} at this address")
        case HTTPException():  # 400: a body that is no multipart body
            return InvalidInput(f"malformed request: {error.detail}")
        case _:
            return as_refine_error(error)
