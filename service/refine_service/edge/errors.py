"""What a caller is told of an exception, over either transport."""

from __future__ import annotations

import logging

from pydantic import ValidationError

from refine_proto.errors import Internal, RefineError, from_validation

log = logging.getLogger(__name__)


def as_refine_error(error: Exception) -> RefineError:
    """The error itself; what is none of the caller's business is logged and becomes INTERNAL."""
    if isinstance(error, RefineError):
        return error
    if isinstance(error, ValidationError):
        return from_validation(error.errors())
    log.error("unexpected %s", type(error).__name__, exc_info=error)
    return Internal("an error of the server, not of the request; it is logged under the request id")
