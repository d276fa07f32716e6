"""The error tree, its one table and the engine's reasons agree."""

from __future__ import annotations

import inspect

import grpc
import pytest

from refine_engine import errors as engine_errors
from refine_proto import errors
from refine_proto.errors import TABLE, CallFailed, JobFailed, RefineError, error_class, from_problem
from refine_proto.models import ProblemDetails


def classes() -> list[type[RefineError]]:
    found = [c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, RefineError)]
    return [c for c in found if "default_reason" in vars(c)]


def test_table_and_tree_have_the_same_reasons() -> None:
    assert {c.default_reason for c in classes()} == set(TABLE)
    assert all(error_class(reason).default_reason == reason for reason in TABLE)


def test_job_failed_is_what_can_end_an_accepted_refinement() -> None:
    ends = {c.default_reason for c in classes() if issubclass(c, JobFailed)}
    assert ends == {"OUT_OF_MEMORY", "WORKER_LOST", "DEADLINE_EXCEEDED", "DIVERGED", "INTERNAL", "CANCELLED"}
    calls = {c.default_reason for c in classes() if issubclass(c, CallFailed)}
    assert calls == {"UPLOAD_TIMEOUT", "SERVER_ERROR"}


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
    assert type(again) is error_class(cls.default_reason)
    assert (again.reason, again.detail, again.request_id) == (cls.default_reason, "expected a, got b", "r")


def test_a_reason_of_a_newer_server_is_kept() -> None:
    problem = ProblemDetails(title="t", status=400, detail="d", reason="BRAND_NEW", retryable=False)
    error = from_problem(problem)
    assert type(error) is RefineError
    assert error.reason == "BRAND_NEW"
    assert error.problem().reason == "BRAND_NEW"
    assert RefineError("another").reason != "BRAND_NEW"


def test_the_tree_is_drawn_completely() -> None:
    assert errors.__doc__
    every = [c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, RefineError)]
    assert [c.__name__ for c in every if c.__name__ not in errors.__doc__] == []
