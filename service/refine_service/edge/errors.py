"""What a caller is told of an exception, over either transport."""

from __future__ import annotations

import logging

from refine_proto.errors import RefineError, ServerError

log = logging.getLogger(__name__)


def as_refine_error(error: Exception) -> RefineError:
    """The error itself; what is none of the caller's business is logged and becomes SERVER_ERROR."""
    if isinstance(error, RefineError):
        return error
    log.error("unexpected %s", type(error).__name__, exc_info=error)
    return ServerError("an error of the server, not of the request; it is logged under the request id")
