"""An error survives the way through google.rpc.Status with everything that REST tells."""

from __future__ import annotations

import pytest
from google.rpc import status_pb2

from refine_proto import errors
from refine_proto.errors import TABLE, RefineError, error_class
from refine_proto.models import FieldError
from refine_proto.status import from_status, to_status


@pytest.mark.parametrize("reason", list(TABLE))
def test_every_reason_survives(reason: str) -> None:
    status = to_status(error_class(reason)("expected a, got b"), request_id="req-1")
    again = from_status(status_pb2.Status.FromString(status.SerializeToString()))
    assert type(again) is error_class(reason)
    assert (again.reason, again.detail, again.request_id) == (reason, "expected a, got b", "req-1")
    assert (again.errors, again.retry_after_s) == ((), None)


def test_fields_and_delay_survive() -> None:
    fields = [FieldError(pointer="/options/iterations", detail="expected at least 1, got 0")]
    invalid = errors.OptionsInvalid("no", errors=fields)
    assert (again := from_status(to_status(invalid))) is not None
    assert again.errors == tuple(fields)
    full = errors.QueueFull("later", retry_after_s=1.5, request_id="req-2")
    assert (again := from_status(to_status(full))) is not None
    assert (again.retry_after_s, again.request_id) == (1.5, "req-2")


def test_a_delay_of_zero_is_not_none() -> None:
    again = from_status(to_status(errors.Draining("now", retry_after_s=0.0)))
    assert again is not None
    assert again.retry_after_s == 0.0


def test_a_delay_is_never_shortened() -> None:
    again = from_status(to_status(errors.QuotaExceeded("slow down", retry_after_s=0.0004)))
    assert again is not None
    assert again.retry_after_s == 0.001


def test_a_reason_of_a_newer_server_is_kept() -> None:
    again = from_status(to_status(RefineError("new", reason="BRAND_NEW")))
    assert type(again) is RefineError
    assert again.reason == "BRAND_NEW"


def test_a_status_of_someone_else_is_none() -> None:
    assert from_status(status_pb2.Status(code=14, message="connection refused")) is None
