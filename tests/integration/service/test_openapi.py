"""The OpenAPI document: complete, its examples valid, and true of the service whatever is sent."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from service_process import Hand, Service

from refine_proto.errors import TABLE
from refine_proto.models import ProblemDetails, Refinement, RefinementSpec


@pytest.fixture
def document(rest: httpx.Client) -> dict[str, Any]:
    found: dict[str, Any] = rest.get("/openapi.json").json()
    return found


def operations(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [operation for path in document["paths"].values() for operation in path.values()]


def test_references_lead_somewhere(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]

    def check(node: Any) -> None:
        if isinstance(node, dict):
            reference = node.get("$ref", "")
            if isinstance(reference, str) and reference:
                assert reference.split("/")[3] in schemas, reference
            for value in node.values():
                check(value)
        elif isinstance(node, list):
            for value in node:
                check(value)

    check(document)
    assert {"Refinement", "RefinementRequest", "RefinementOptions", "ProblemDetails", "Event"} <= set(schemas)


def test_errors_are_problems_with_an_example_for_each_reason(document: dict[str, Any]) -> None:
    told = set()
    for operation in operations(document):
        for status, answer in operation["responses"].items():
            if status < "400":
                continue
            [(media_type, content)] = answer["content"].items()
            assert media_type == "application/problem+json"
            for reason, example in content["examples"].items():
                problem = ProblemDetails.model_validate(example["value"])
                assert (problem.reason, problem.status) == (reason, int(status))
                told.add(reason)
    assert told <= set(TABLE)
    assert {"MESH_INVALID", "PAYLOAD_TOO_LARGE", "QUOTA_EXCEEDED", "QUEUE_FULL", "EXPIRED"} <= told


def test_examples_are_valid(document: dict[str, Any]) -> None:
    post = document["paths"]["/v1/refinements"]["post"]
    for content in post["requestBody"]["content"].values():
        fields = {
            name: value for name, value in content["example"].items() if name not in ("mesh", "silhouette")
        }
        RefinementSpec.model_validate(fields)
    for status in ("200", "202"):
        Refinement.model_validate(post["responses"][status]["content"]["application/json"]["example"])


@pytest.mark.slow
def test_whatever_is_sent_the_document_is_true(service: Service, hand: Hand) -> None:
    """Schemathesis: no 5xx, no undocumented status, media type or body."""
    hand.show_slot()
    schema = schemathesis.openapi.from_url(f"{service.rest_url}/openapi.json")
    # Event streams and waits end when a job does, and no worker runs here.
    checks = [
        not_a_server_error,
        status_code_conformance,
        content_type_conformance,
        response_schema_conformance,
    ]
    tested = 0
    for result in schema.get_all_operations():
        operation = result.ok()
        tested += 1

        @settings(
            max_examples=40,
            deadline=None,
            database=None,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @schemathesis_given(operation)
        def run(case: Any) -> None:
            case.headers = {**(case.headers or {}), "Prefer": "wait=0"}
            case.call_and_validate(base_url=service.rest_url, checks=checks, timeout=30)

        run()
    assert tested == len(operations(schema.raw_schema))


def schemathesis_given(operation: Any) -> Any:
    from hypothesis import given

    return given(case=operation.as_strategy())
