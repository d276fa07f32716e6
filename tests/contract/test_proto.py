"""The messages, their models and the committed stubs are one contract."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from pydantic import BaseModel, TypeAdapter, ValidationError

from refine_proto import models
from refine_proto.checks import Code
from refine_proto.convert import tagged_union, to_message, to_model
from refine_proto.errors import from_validation
from refine_proto.strict import Input
from refine_proto.v1 import refine_pb2 as pb

ROOT = Path(__file__).parents[2]
POSE: list[list[float]] = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
LOOK_AT: dict[str, Any] = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.9}
MATRIX: dict[str, Any] = {
    "type": "matrix",
    "convention": "opengl",
    "camera_to_world": POSE,
    "fov_y_degrees": 50,
}
MATRIX_CAMERA = models.MatrixCamera.model_validate(MATRIX)


def messages() -> list[Descriptor]:
    """All messages that carry meaning; Requests and Chunks are the envelopes of the calls."""
    found = pb.DESCRIPTOR.message_types_by_name
    return [descriptor for name, descriptor in found.items() if not name.endswith(("Request", "Chunk"))]


@pytest.mark.parametrize("message", messages(), ids=lambda m: m.name)
def test_message_and_model_have_the_same_fields(message: Descriptor) -> None:
    tag = tagged_union(message)
    model = getattr(models, message.name)
    if tag is not None:
        members = TypeAdapter(model).json_schema()["discriminator"]
        assert members["propertyName"] == tag
        named = {name: ref.rsplit("/", 1)[1] for name, ref in members["mapping"].items()}
        assert named == {f.name: f.message_type.name for f in message.fields if f.message_type}
        return
    fields = dict(model.model_fields)
    if fields.get("type") and fields["type"].annotation in _tags():
        del fields["type"]
    assert set(fields) == {f.name for f in message.fields}
    for field in message.fields:
        _same_shape(model, field)


def _tags() -> list[Any]:
    return [
        models.LookAtCamera.model_fields["type"].annotation,
        models.MatrixCamera.model_fields["type"].annotation,
        models.PyTorch3DCamera.model_fields["type"].annotation,
        models.NetworkCamera.model_fields["type"].annotation,
        models.EstimatedCamera.model_fields["type"].annotation,
    ]


def _same_shape(model: type[BaseModel], field: FieldDescriptor) -> None:
    """Optional, repeated and enum agree."""
    schema = model.model_json_schema(mode="serialization")
    text = schema["properties"][field.name]
    options = [_resolve(option, schema) for option in text.get("anyOf", [text])]
    value = next(option for option in options if option.get("type") != "null")
    where = f"{model.__name__}.{field.name}"
    if {"type": "null"} in options:
        assert field.has_presence or field.is_repeated, f"{where} may be null, so its field must be optional"
    is_map = field.message_type is not None and field.message_type.GetOptions().map_entry
    assert (value.get("type") == "array") == (field.is_repeated and not is_map), where
    if field.enum_type is not None:
        wire = [v.name.lower() for v in field.enum_type.values if v.number]
        one = _resolve(value["items"], schema) if "items" in value else value
        assert wire == one["enum"], where


def _resolve(schema: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = root["$defs"][schema["$ref"].rsplit("/", 1)[1]] if "$ref" in schema else schema
    return found


def test_every_model_has_a_message() -> None:
    bases = {Input, models.Output}
    of_rest = {models.RefinementRequest, models.ViewRequest, models.ImageFiles}
    without = of_rest | {models.Judgement}  # which is between worker and edge
    found = {
        v
        for v in vars(models).values()
        if isinstance(v, type) and issubclass(v, BaseModel) and v is not BaseModel
    }
    assert {m.__name__ for m in found - bases - without} == {m.name for m in messages()} - {"CameraSpec"}


def a_finding() -> models.Finding:
    pose = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 2), (0, 0, 0, 1))
    camera = models.MatrixCamera(convention="opencv", world_to_camera=pose, fov_y_degrees=40)
    return models.Finding(
        code=Code.CAMERA_MISREAD,
        severity=models.Severity.WARNING,
        message="m",
        reading=models.Reading(name="azimuth negated", silhouette_iou=0.9, camera=camera),
    )


def test_a_finding_of_a_newer_server_is_read() -> None:
    """With a code, a severity and fields that are not known here."""
    sent = a_finding().model_dump(mode="json", exclude_none=True)
    sent |= {"code": "LENS_DIRTY", "severity": "ruinous", "since": 3}
    found = models.Finding.model_validate(sent)
    assert (found.code, found.severity) == ("LENS_DIRTY", "ruinous")
    assert found.reading == a_finding().reading
    sent["reading"]["camera"] = {"type": "fisheye"}
    assert models.Finding.model_validate(sent).reading is None


def a_refinement() -> models.Refinement:
    now = datetime(2026, 3, 1, 12, 30, 15, 250_000, tzinfo=UTC)
    return models.Refinement(
        id="x",
        state=models.State.FAILED,
        options=models.RefinementOptions(preset=models.Preset.FAST, iterations=20, symmetry_offset=-0.25),
        progress=models.Progress(
            iteration=3, total=20, percent=15.0, losses={"total": 1.25, "silhouette": 0.1}
        ),
        error=models.ProblemDetails(
            title="t",
            status=422,
            detail="d",
            reason="MESH_INVALID",
            retryable=False,
            errors=[models.FieldError(pointer="/mesh", detail="no")],
        ),
        artifacts=[
            models.Artifact(name="report.json", media_type="application/json", size_bytes=2**40, sha256="ab")
        ],
        created_at=now,
        started_at=now,
        expires_at=now,
        queue_position=0,
        eta_s=12.5,
        silhouette_iou=models.SilhouetteIou(before=0.0, after=0.9),
        attempt=1,
        checks=[a_finding()],
        urls=models.RefinementUrls(refinement="/a", events="/b", cancel="/c"),
        metadata={"set": "chairs", "n": "3"},
        webhook_deliveries=[
            models.WebhookDelivery(attempt=1, time=now, status=503, error="e", next_attempt_at=now),
            models.WebhookDelivery(attempt=2, time=now, status=204),
        ],
    )


def test_a_refinement_survives_the_wire() -> None:
    refinement = a_refinement()
    message = to_message(refinement, pb.Refinement)
    assert message.state == pb.Refinement.FAILED
    assert message.artifacts[0].size_bytes == 2**40
    assert to_model(pb.Refinement.FromString(message.SerializeToString()), models.Refinement) == refinement


def test_an_event_survives_the_wire() -> None:
    event = models.Event(
        sequence=2**40,
        type=models.EventType.COMPLETED,
        time=datetime(2026, 3, 1, tzinfo=UTC),
        state=models.State.FAILED,
        refinement=a_refinement(),
    )
    assert to_model(to_message(event, pb.Event), models.Event) == event


WITHOUT_FOV = {name: value for name, value in MATRIX.items() if name != "fov_y_degrees"}
CAMERAS: list[dict[str, Any]] = [
    LOOK_AT,
    MATRIX,
    WITHOUT_FOV | {"intrinsics": {"fx": 50, "fy": 40, "cx": 32, "cy": 24}},
    WITHOUT_FOV | {"intrinsics": {"fx": 50, "fy": 40, "cx": 32, "cy": 24, "width": 64, "height": 48}},
    WITHOUT_FOV | {"intrinsics": {"fx": 5, "fy": 5, "cx": 32, "cy": 24}, "projection": "orthographic"},
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_spec_survives_the_wire(camera: dict[str, Any]) -> None:
    webhook = {"url": "https://example.com/hook", "events": ["failed", "cancelled"]}
    spec = models.RefinementSpec.model_validate(
        {"camera": camera, "mesh_format": "glb", "webhook": webhook, "metadata": {"set": "chairs", "n": ""}}
    )
    message = to_message(spec, pb.RefinementSpec)
    assert message.camera.WhichOneof("type") == camera["type"]
    assert to_model(message, models.RefinementSpec) == spec


def test_unset_message_fields_take_the_models_defaults() -> None:
    message = pb.RefinementSpec(camera=pb.CameraSpec(look_at=pb.LookAtCamera(distance=1.9)))
    spec = to_model(message, models.RefinementSpec)
    assert spec.options == models.RefinementOptions()
    assert spec.mesh_format is None
    assert isinstance(spec.camera, models.LookAtCamera)
    assert spec.camera.fov_y_degrees == 60.0


@pytest.mark.parametrize("message", [pb.RefinementSpec(), pb.RefinementSpec(camera=pb.CameraSpec())])
def test_a_message_without_a_camera_is_refused(message: pb.RefinementSpec) -> None:
    with pytest.raises(ValidationError, match="camera"):
        to_model(message, models.RefinementSpec)


def test_rows_and_sixteen_numbers_are_the_same_matrix() -> None:
    flat = [value for row in POSE for value in row]
    assert models.MatrixCamera.model_validate(MATRIX | {"camera_to_world": flat}) == MATRIX_CAMERA
    assert models.MatrixCamera.model_validate(MATRIX) == MATRIX_CAMERA


SCALED = [[2.0, 0, 0, 0], *POSE[1:]]
MIRRORED = [[-1.0, 0, 0, 0], *POSE[1:]]
TRANSPOSED = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 2, 1]]
ORTHOGRAPHIC = {"projection": "orthographic"}


@pytest.mark.parametrize(
    ("part", "value", "reason", "pointer", "says"),
    [
        ("options", {"iteratons": 3}, "OPTIONS_INVALID", "/options/iteratons", "did you mean 'iterations'"),
        ("options", {"preset": "best"}, "OPTIONS_INVALID", "/options/preset", "'paper', 'default' or 'fast'"),
        (
            "options",
            {"iterations": 0},
            "OPTIONS_INVALID",
            "/options/iterations",
            "greater than or equal to 1",
        ),
        ("options", {"symmetry_normal": [0, 0, 0]}, "OPTIONS_INVALID", "/options/symmetry_normal", "length"),
        (
            "options",
            {"symmetry_offset": float("nan")},
            "OPTIONS_INVALID",
            "/options/symmetry_offset",
            "finite",
        ),
        ("camera", LOOK_AT | {"distance": 0}, "CAMERA_INVALID", "/camera/distance", "greater than 0"),
        ("camera", LOOK_AT | {"fov": 3}, "CAMERA_INVALID", "/camera/fov", "did you mean 'fov_y_degrees'"),
        ("camera", {"type": "fisheye"}, "CAMERA_INVALID", "/camera", "'look_at', 'matrix'"),
        (
            "camera",
            MATRIX | {"camera_to_world": SCALED},
            "CAMERA_INVALID",
            "/camera/camera_to_world",
            "scale",
        ),
        (
            "camera",
            MATRIX | {"camera_to_world": MIRRORED},
            "CAMERA_INVALID",
            "/camera/camera_to_world",
            "mirrored",
        ),
        (
            "camera",
            MATRIX | {"camera_to_world": TRANSPOSED},
            "CAMERA_INVALID",
            "/camera/camera_to_world",
            "transpose",
        ),
        (
            "camera",
            MATRIX | {"camera_to_world": [POSE[0]]},
            "CAMERA_INVALID",
            "/camera/camera_to_world",
            "four rows of four numbers",
        ),
        (
            "camera",
            MATRIX | {"world_to_camera": POSE},
            "CAMERA_INVALID",
            "/camera",
            "exactly one of world",
        ),
        (
            "camera",
            MATRIX | {"fov_y_degrees": None},
            "CAMERA_INVALID",
            "/camera",
            "exactly one of intrinsics",
        ),
        ("camera", MATRIX | ORTHOGRAPHIC, "CAMERA_INVALID", "/camera", "expected intrinsics"),
        ("mesh_format", "fbx", "FORMAT_UNSUPPORTED", "/mesh_format", "'glb'"),
    ],
)
def test_a_bad_spec_is_named(part: str, value: Any, reason: str, pointer: str, says: str) -> None:
    with pytest.raises(ValidationError) as caught:
        models.RefinementSpec.model_validate({"camera": LOOK_AT, part: value})
    error = from_validation(caught.value.errors())
    assert (error.reason, error.errors[0].pointer) == (reason, pointer)
    assert says in error.errors[0].detail


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        ({"a b": "c"}, "pattern"),
        ({"": "c"}, "pattern"),
        ({"a": "c" * 513}, "512"),
        ({"a": 3}, "string"),
        ({str(n): "" for n in range(21)}, "20"),
    ],
)
def test_metadata_are_few_and_short(metadata: Any, says: str) -> None:
    with pytest.raises(ValidationError) as caught:
        models.RefinementSpec.model_validate({"camera": LOOK_AT, "metadata": metadata})
    error = from_validation(caught.value.errors())
    assert (error.reason, error.errors[0].pointer[:9]) == ("INPUT_INVALID", "/metadata")
    assert says in error.detail


def test_errors_in_several_parts_are_all_listed() -> None:
    with pytest.raises(ValidationError) as caught:
        models.RefinementSpec.model_validate({"camera": {"type": "look_at"}, "options": {"seed": -1}})
    error = from_validation(caught.value.errors())
    assert error.reason == "INPUT_INVALID"
    assert {f.pointer for f in error.errors} >= {"/camera/distance", "/options/seed"}


def test_an_older_client_reads_a_newer_server() -> None:
    body = a_refinement().model_dump(mode="json")
    body["options"]["brand_new"] = 1
    assert models.Refinement.model_validate(body | {"also_new": 2}) == a_refinement()


def test_a_state_and_a_preset_of_a_newer_version_stay_what_they_are() -> None:
    body = a_refinement().model_dump(mode="json") | {"state": "parked"}
    body["options"]["preset"] = "sharp"
    refinement = models.Refinement.model_validate(body)
    assert (refinement.state, refinement.options.preset) == ("parked", "sharp")
    assert not refinement.state.terminal
    assert refinement.model_dump(mode="json") == body
    with pytest.raises(ValidationError):
        models.Refinement.model_validate(body | {"state": 3})


def test_on_the_wire_they_have_numbers_or_are_unspecified() -> None:
    message = to_message(a_refinement(), pb.Refinement)
    newer = pb.Refinement.FromString(message.SerializeToString())
    newer.ClearField("state")
    newer.options.ClearField("preset")
    newer.MergeFromString(b"\x10\x63\x1a\x02\x08\x62")  # state = 99, options.preset = 98
    refinement = to_model(newer, models.Refinement)
    assert (refinement.state, refinement.options.preset) == ("99", "98")
    again = to_message(refinement, pb.Refinement)
    assert (again.state, again.options.preset) == (pb.Refinement.STATE_UNSPECIFIED, 0)
    assert to_model(again, models.Refinement).state == "state_unspecified"


def test_a_required_value_that_is_left_out_is_refused_by_its_name() -> None:
    spec = models.RefinementSpec(camera=MATRIX_CAMERA)
    message = to_message(spec, pb.RefinementSpec)
    message.camera.matrix.ClearField("convention")
    with pytest.raises(ValidationError, match="'opencv', 'opengl' or 'pytorch3d'"):
        to_model(message, models.RefinementSpec)


def test_committed_stubs_are_what_the_generator_makes(tmp_path: Path) -> None:
    subprocess.run([ROOT / "scripts/generate-proto", tmp_path], check=True)
    made = {p.name: p.read_text() for p in (tmp_path / "refine_proto/v1").iterdir()}
    committed = ROOT / "proto/refine_proto/v1"
    assert made == {name: (committed / name).read_text() for name in made}
    assert set(made) == {"refine_pb2.py", "refine_pb2.pyi", "refine_pb2_grpc.py"}
