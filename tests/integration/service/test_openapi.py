"""The OpenAPI document: complete, its examples valid, and true of the service whatever is sent."""

from __future__ import annotations

import base64
import json
from collections import Counter
from contextlib import suppress
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from judgement import ESTIMATE
from schemathesis import GenerationMode as Mode
from schemathesis.checks import not_a_server_error
from schemathesis.core.result import Ok
from schemathesis.schemas import APIOperation
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from service_process import CAMERA, MESH, PNG, Hand, Service

from refine_jobs.record import Task
from refine_proto.errors import TABLE
from refine_proto.models import ProblemDetails, Refinement, RefinementSpec, Validation

ARTIFACT = "/v1/refinements/{refinement_id}/artifacts/{name}"
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]
SOME = settings(
    max_examples=25,
    deadline=None,
    database=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


@pytest.fixture
def document(rest: httpx.Client) -> dict[str, Any]:
    found: dict[str, Any] = rest.get("/openapi.json").json()
    return found


def operations(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Verb and description of each."""
    return [operation for path in document["paths"].values() for operation in path.items()]


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
    for verb, operation in operations(document):
        for status, answer in operation["responses"].items():
            if status < "400" or verb == "head":  # which answers without a body
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


def test_whatever_is_sent_the_document_is_true(service: Service, hand: Hand) -> None:
    """Schemathesis: no 5xx, no undocumented status, media type or body."""
    schema = schemathesis.openapi.from_url(f"{service.rest_url}/openapi.json")
    answers = {Task.VALIDATE: Validation.of(0.5, ["a warning"], []), Task.ESTIMATE: ESTIMATE}
    with hand.answering(lambda job: hand.store.answer(job, answers[job.task])):
        for operation in [found.ok() for found in schema.get_all_operations() if isinstance(found, Ok)]:
            check_operation(operation, service, hand)
    calls = [line for line in service.log() if line["logger"].endswith("rest.middleware")]
    answered = Counter(f"{line['method']} {line['status']}" for line in calls)
    for expected in ("POST /v1/refinements 202", "POST /v1/refinements 422", f"GET {ARTIFACT} 200"):
        assert answered[expected] > 5, answered
    assert answered["POST /v1/refinements:validate 200"] > 1, answered
    for call in document_calls(schema.raw_schema):
        assert any(seen.startswith(call) for seen in answered), call


def document_calls(document: dict[str, Any]) -> list[str]:
    return [f"{verb.upper()} {path} " for path, verbs in document["paths"].items() for verb in verbs]


def check_operation(operation: APIOperation[Any, Any, Any, Any], service: Service, hand: Hand) -> None:
    """Valid and invalid requests; what the answers must be is in CHECKS."""
    hand.show_slot()
    with service.client("rest") as client:
        ended = client.submit(MESH, PNG, CAMERA, mesh_format="obj").id
    hand.run(ended, {"refined.glb": b"glTF"})

    def check(case: schemathesis.Case[Any]) -> None:
        case.headers["Prefer"] = "wait=0"
        if str(case.query.get("slots")).isdecimal():
            case.query["slots"] = 0  # for more than there are the answer is 503, as told
        case.call_and_validate(base_url=service.rest_url, checks=CHECKS, timeout=30)

    def check_meaningful(case: schemathesis.Case[Any]) -> None:
        """Random bytes are no mesh, random ids no refinement, random keys no sign-in: put real ones in."""
        case.headers.pop("Authorization", None)
        if "refinement_id" in case.path_parameters:
            case.path_parameters["refinement_id"] = ended
        if "name" in case.path_parameters:
            case.path_parameters["name"] = "refined.glb"
        if isinstance(case.body, dict):
            files = {"mesh": MESH, "silhouette": PNG}
            encoded = {name: base64.b64encode(data).decode() for name, data in files.items()}
            real: dict[str, Any] = {**(encoded if case.media_type == "application/json" else files)}
            case.body = case.body | real | {"mesh_format": "obj"}
            real_camera: Any = CAMERA
            if operation.path.endswith(":validate"):  # few drawn cameras are rigid
                case.body["camera"] = (
                    real_camera if case.media_type == "application/json" else json.dumps(real_camera)
                )
                case.body.pop("views", None)  # each would need files of its own
        check(case)

    for mode, act in ((Mode.POSITIVE, check), (Mode.POSITIVE, check_meaningful), (Mode.NEGATIVE, check)):
        with suppress(Unsatisfiable):  # nothing can be wrong in a request without parameters
            SOME(given(operation.as_strategy(generation_mode=mode))(act))()
