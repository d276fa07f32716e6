"""What a caller is told of an exception, over either transport."""

from __future__ import annotations

import logging

from refine_jobs.blobs import BlobStoreFailed
from refine_proto.errors import RefineError, ServerError, Unavailable

_RETRY_S = 5.0  # somebody has to make room

log = logging.getLogger(__name__)


def as_refine_error(error: Exception) -> RefineError:
    """The error itself; what is none of the caller's business is logged and becomes SERVER_ERROR."""
    if isinstance(error, RefineError):
        return error
    if isinstance(error, BlobStoreFailed):
        log.error("%s", error)
        return Unavailable("the blob store does not work; the service's log says why", retry_after_s=_RETRY_S)
    log.error("unexpected %s", type(error).__name__, exc_info=error)
    return ServerError("an error of the server, not of the request; it is logged under the request id")
