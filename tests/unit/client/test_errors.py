"""Why a terminal refinement has no result."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from refine_client.errors import error_of
from refine_proto import errors
from refine_proto.models import Refinement, RefinementOptions, State

NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.mark.parametrize(
    ("state", "error", "says"),
    [
        (State.CANCELLED, errors.Cancelled, "job-1 was cancelled"),
        (State.EXPIRED, errors.Expired, "job-1 has expired; submit it again"),
        (State.FAILED, errors.Internal, "job-1 is failed and does not say why"),
    ],
)
def test_a_record_that_does_not_say_why(state: State, error: type[errors.RefineError], says: str) -> None:
    options = RefinementOptions()
    refinement = Refinement(id="job-1", state=state, options=options, created_at=NOW, expires_at=NOW)
    why = error_of(refinement)
    assert type(why) is error
    assert says in why.detail
