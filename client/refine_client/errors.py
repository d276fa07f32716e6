"""What the client itself finds wrong; everything else comes from the tree of `refine_proto.errors`."""

from __future__ import annotations

from refine_proto.errors import Cancelled, Expired, Internal, RefineError, Unavailable, from_problem
from refine_proto.models import Refinement, State


class ConnectionLost(Unavailable):
    """No answer, or only a part of one: refused, reset, timed out. Reason UNAVAILABLE."""


class DownloadCorrupt(Unavailable):
    """The bytes that came are not those that the server announced. Reason UNAVAILABLE."""


def error_of(refinement: Refinement) -> RefineError | None:
    """Why a terminal refinement has no result; None if it succeeded."""
    if refinement.state is State.SUCCEEDED:
        return None
    if refinement.error is not None:
        return from_problem(refinement.error)
    if refinement.state is State.CANCELLED:
        return Cancelled(f"refinement {refinement.id} was cancelled")
    if refinement.state is State.EXPIRED:
        return Expired(f"refinement {refinement.id} has expired; submit it again")
    return Internal(f"refinement {refinement.id} is {refinement.state} and does not say why")
