"""The error tree, its one table and the engine's reasons agree."""

from __future__ import annotations

import inspect

import grpc
import pytest

from refine_engine import errors as engine_errors
from refine_proto import errors
from refine_proto.errors import TABLE, RefineError, error_class, from_problem
from refine_proto.models import ProblemDetails


def classes() -> list[type[RefineError]]:
    found = [c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, RefineError)]
    return [c for c in found if "reason" in vars(c)]


def test_table_and_tree_have_the_same_reasons() -> None:
    assert {c.reason for c in classes()} == set(TABLE)
    assert all(error_class(reason).reason == reason for reason in TABLE)


def test_the_engines_reasons_are_in_the_table() -> None:
    found = [c for _, c in inspect.getmembers(engine_errors, inspect.isclass) if issubclass(c, Exception)]
    assert len(found) > 5
    assert {vars(c)["reason"] for c in found} <= set(TABLE)


@pytest.mark.parametrize("reason", list(TABLE))
def test_statuses_exist(reason: str) -> None:
    status = TABLE[reason]
    assert grpc.StatusCode[status.grpc] is not grpc.StatusCode.OK
    assert 400 <= status.http < 600


@pytest.mark.parametrize("cls", classes(), ids=lambda c: c.__name__)
def test_an_error_survives_as_problem_details(cls: type[RefineError]) -> None:
    problem = cls("expected a, got b", request_id="r").problem(instance="/v1/refinements/x")
    again = from_problem(ProblemDetails.model_validate_json(problem.model_dump_json()))
    assert type(again) is error_class(cls.reason)
    assert (again.reason, again.detail, again.request_id) == (cls.reason, "expected a, got b", "r")


def test_a_reason_of_a_newer_server_is_kept() -> None:
    problem = ProblemDetails(title="t", status=400, detail="d", reason="BRAND_NEW", retryable=False)
    error = from_problem(problem)
    assert type(error) is RefineError
    assert error.reason == "BRAND_NEW"
    assert error.problem().reason == "BRAND_NEW"


def test_the_tree_is_drawn_completely() -> None:
    assert errors.__doc__
    missing = [c.__name__ for c in classes() if c.__name__ not in errors.__doc__]
    assert missing == []
