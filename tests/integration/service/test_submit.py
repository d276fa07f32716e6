"""What may be sent, how it is answered, and how what is wrong is told."""

from __future__ import annotations

import base64
import json
import threading
import time
from typing import Any

import httpx
import pytest
from service_process import CAMERA, MESH, PNG, Hand, Service, png

from refine_client import RefineClient, View
from refine_jobs import keys
from refine_proto.errors import (
    CameraInvalid,
    FormatUnsupported,
    IdempotencyKeyReused,
    MeshInvalid,
    OptionsInvalid,
    RefineError,
    SilhouetteInvalid,
)
from refine_proto.models import Refinement, State

TRACEPARENT = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
MATRIX: dict[str, Any] = {
    "type": "matrix",
    "convention": "opencv",
    "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]],
    "intrinsics": {"fx": 10, "fy": 10, "cx": 4, "cy": 4, "width": 8, "height": 9},
}


def multipart(**changes: Any) -> dict[str, Any]:
    parts: dict[str, Any] = {
        "mesh": ("coarse.obj", MESH),
        "silhouette": ("silhouette.png", PNG),
        "camera": ("camera.json", json.dumps(CAMERA)),
    }
    return {name: part for name, part in (parts | changes).items() if part is not None}


def test_a_multipart_body(rest: httpx.Client, hand: Hand) -> None:
    headers = {"X-Request-Id": "req-7", "traceparent": TRACEPARENT}
    options = json.dumps({"preset": "fast", "seed": 7})
    answer = rest.post("/v1/refinements", files=multipart(options=(None, options)), headers=headers)
    assert answer.status_code == 202
    refinement = Refinement.model_validate_json(answer.content)
    assert answer.headers["Location"] == f"/v1/refinements/{refinement.id}"
    assert (refinement.state, refinement.queue_position) == (State.QUEUED, 0)
    assert (refinement.options.preset, refinement.options.seed) == ("fast", 7)
    assert refinement.options.timeout_s == 3600  # effective
    assert (answer.headers["X-Request-Id"], answer.headers["traceparent"]) == ("req-7", TRACEPARENT)
    assert rest.get(answer.headers["Location"]).json() == answer.json()

    job = hand.start(refinement.id)
    assert (job.request_id, job.traceparent) == ("req-7", TRACEPARENT)
    assert (job.owner, job.spec["mesh_format"]) == ("anonymous", "obj")
    assert hand.blobs.get(keys.input_blob(job.id, keys.MESH)) == MESH
    assert hand.blobs.get(keys.input_blob(job.id, keys.SILHOUETTE)) == PNG


def test_a_json_body(rest: httpx.Client, hand: Hand) -> None:
    files = {"mesh": base64.b64encode(MESH).decode(), "silhouette": base64.b64encode(PNG).decode()}
    body = {**files, "mesh_format": "obj", "camera": CAMERA, "options": {"iterations": 20}}
    answer = rest.post("/v1/refinements", json=body)
    assert answer.status_code == 202
    job = hand.start(answer.json()["id"])
    assert job.spec["options"]["iterations"] == 20
    assert hand.blobs.get(keys.input_blob(job.id, keys.MESH)) == MESH


def test_both_transports_make_the_same_job(service: Service, hand: Hand) -> None:
    jobs = []
    for transport in ("rest", "grpc"):
        with service.client(transport) as client:
            sent = client.submit(MESH, PNG, CAMERA, {"seed": 3}, mesh_format="obj")
        jobs.append(hand.start(sent.id))
    first, second = jobs
    assert (first.spec, first.mesh, first.silhouette) == (second.spec, second.mesh, second.silhouette)


SIDE = {**CAMERA, "azimuth_degrees": 120}
VIEWS = [View(png(16, 8), SIDE, png(16, 8)), View(PNG, SIDE)]
IMAGES = {
    "silhouette": PNG,
    "ignore": PNG,
    "silhouette_2": png(16, 8),
    "ignore_2": png(16, 8),
    "silhouette_3": PNG,
}


def test_several_views_reach_the_worker_over_every_way(
    service: Service, rest: httpx.Client, hand: Hand
) -> None:
    """JSON, REST's and gRPC's parts: the same files by the same names, the same spec."""
    encoded = {name: base64.b64encode(data).decode() for name, data in {**IMAGES, "mesh": MESH}.items()}
    views = [
        {"camera": SIDE, "silhouette": encoded["silhouette_2"], "ignore": encoded["ignore_2"]},
        {"camera": SIDE, "silhouette": encoded["silhouette_3"]},
    ]
    first = {name: encoded[name] for name in ("mesh", "silhouette", "ignore")}
    body = {**first, "camera": CAMERA, "mesh_format": "obj", "views": views}
    ids = [rest.post("/v1/refinements", json=body).json()["id"]]
    for transport in ("rest", "grpc"):
        with service.client(transport) as client:
            ids.append(client.submit(MESH, PNG, CAMERA, mesh_format="obj", ignore=PNG, views=VIEWS).id)
    jobs = [hand.start(job_id) for job_id in ids]
    for job in jobs:
        assert job.spec == jobs[0].spec
        assert [view["camera"]["azimuth_degrees"] for view in job.spec["views"]] == [120, 120]
        assert set(job.more_files) == set(IMAGES) - {"silhouette"}
        for name, data in IMAGES.items():
            assert hand.blobs.get(keys.input_blob(job.id, name)) == data


def test_an_idempotency_key_covers_all_files(client: RefineClient) -> None:
    def submit(views: list[View], ignore: bytes | None = None) -> Refinement:
        return client.submit(
            MESH, PNG, CAMERA, mesh_format="obj", idempotency_key="k", ignore=ignore, views=views
        )

    first = submit(VIEWS)
    assert submit(VIEWS).id == first.id
    with pytest.raises(IdempotencyKeyReused):
        submit([VIEWS[0], View(png(9, 9), SIDE)])
    with pytest.raises(IdempotencyKeyReused):
        submit(VIEWS, ignore=PNG)


@pytest.mark.parametrize(
    ("views", "error", "pointer"),
    [
        ([View(b"GIF89a", CAMERA)], FormatUnsupported, "/silhouette_2"),
        ([View(PNG, CAMERA), View(PNG, CAMERA, PNG[:20])], SilhouetteInvalid, "/ignore_3"),
        ([View(PNG, MATRIX)], CameraInvalid, "/views/0/camera/intrinsics"),
    ],
)
def test_bad_content_of_a_further_view_is_told_alike(
    client: RefineClient, views: list[View], error: type[RefineError], pointer: str
) -> None:
    with pytest.raises(error) as caught:
        client.submit(MESH, PNG, CAMERA, mesh_format="obj", views=views)
    assert [field.pointer for field in caught.value.errors] == [pointer]


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        (
            {"silhouette_2": PNG},
            "/silhouette_2: expected no file of this name, got one: `views` has 0 further",
        ),
        (
            {"ignore_2": PNG, "views": (None, json.dumps([{"camera": CAMERA}]))},
            "/silhouette_2: expected a file",
        ),
        ({"views": (None, json.dumps([{"camera": {}}]))}, "/views/0/camera: expected"),
        ({"silhouette_9": PNG}, "/silhouette_9: unknown field"),
    ],
)
def test_parts_and_views_that_do_not_fit(rest: httpx.Client, parts: dict[str, Any], says: str) -> None:
    answer = rest.post("/v1/refinements", files=multipart(**parts))
    assert answer.status_code == 422
    assert says in answer.json()["detail"]


@pytest.mark.parametrize(
    ("changes", "error", "pointer"),
    [
        ({"mesh": b""}, MeshInvalid, "/mesh"),
        ({"mesh": b"plymouth", "mesh_format": "ply"}, MeshInvalid, "/mesh"),
        ({"mesh": b"\x00\x01", "mesh_format": None}, FormatUnsupported, "/mesh_format"),
        ({"silhouette": b""}, SilhouetteInvalid, "/silhouette"),
        ({"silhouette": b"GIF89a"}, FormatUnsupported, "/silhouette"),
        ({"silhouette": PNG[:20]}, SilhouetteInvalid, "/silhouette"),
        ({"silhouette": png(4097, 8)}, SilhouetteInvalid, "/silhouette"),
        ({"camera": MATRIX}, CameraInvalid, "/camera/intrinsics"),
        ({"options": {"timeout_s": 4000}}, OptionsInvalid, "/options/timeout_s"),
    ],
)
def test_bad_content_is_told_alike(
    client: RefineClient, changes: dict[str, Any], error: type[RefineError], pointer: str
) -> None:
    sent = {"mesh": MESH, "silhouette": PNG, "camera": CAMERA, "mesh_format": "obj"} | changes
    with pytest.raises(error) as caught:
        client.submit(**sent)
    assert [field.pointer for field in caught.value.errors] == [pointer]
    assert caught.value.request_id
    assert client.list().refinements == []


@pytest.mark.parametrize(
    ("changes", "status", "reason", "pointer", "says"),
    [
        (
            {"options": (None, '{"iteration": 5}')},
            422,
            "OPTIONS_INVALID",
            "/options/iteration",
            "'iterations'",
        ),
        ({"options": (None, "{")}, 422, "OPTIONS_INVALID", "/options", "JSON"),
        ({"options": (None, "[" * 9999)}, 422, "OPTIONS_INVALID", "/options", "JSON"),
        ({"camera": None}, 422, "CAMERA_INVALID", "/camera", "required"),
        ({"camera": (None, '{"type": "look_at"}')}, 422, "CAMERA_INVALID", "/camera/distance", "required"),
        ({"camera": (None, '{"type": "fisheye"}')}, 422, "CAMERA_INVALID", "/camera", "fisheye"),
        ({"mesh": None}, 422, "MESH_INVALID", "/mesh", "got none"),
        ({"mesh": (None, MESH)}, 422, "MESH_INVALID", "/mesh", "without a file name"),
        ({"mesh": ("coarse.fbx", b"Kaydara")}, 415, "FORMAT_UNSUPPORTED", "/mesh_format", "glb"),
        ({"mesh_format": (None, "fbx")}, 415, "FORMAT_UNSUPPORTED", "/mesh_format", "glb"),
        ({"mash": (None, "1")}, 422, "INPUT_INVALID", "/mash", "unknown field 'mash'"),
    ],
)
def test_bad_fields(
    rest: httpx.Client, changes: dict[str, Any], status: int, reason: str, pointer: str, says: str
) -> None:
    answer = rest.post("/v1/refinements", files=multipart(**changes))
    problem = answer.json()
    assert (answer.status_code, problem["reason"]) == (status, reason), problem
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert pointer in [field["pointer"] for field in problem["errors"]]
    assert says in problem["detail"]
    assert problem["request_id"] == answer.headers["X-Request-Id"]
    assert problem["retryable"] is False


@pytest.mark.parametrize(
    ("content_type", "body", "status"),
    [
        ("text/plain", b"hello", 415),
        ("", b"", 415),
        ("application/json", b"{", 422),
        ("application/json", b"[]", 422),
        ("multipart/form-data", b"x", 422),  # no boundary
        ("multipart/form-data; boundary=b", b"--b\r\nnonsense", 422),
        ("multipart/form-data; boundary=b", b"--b--\r\n", 422),
    ],
)
def test_bad_bodies(rest: httpx.Client, content_type: str, body: bytes, status: int) -> None:
    answer = rest.post("/v1/refinements", content=body, headers={"Content-Type": content_type})
    assert answer.status_code == status, answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"


def test_a_key_gives_the_first_answer_again(client: RefineClient) -> None:
    first = client.submit(MESH, PNG, CAMERA, mesh_format="obj", idempotency_key="order-66")
    again = client.submit(MESH, PNG, CAMERA, mesh_format="obj", idempotency_key="order-66")
    assert again == first
    assert len(client.list().refinements) == 1
    with pytest.raises(IdempotencyKeyReused, match=first.id):
        client.submit(MESH + b"#", PNG, CAMERA, mesh_format="obj", idempotency_key="order-66")


def test_a_replay_is_marked(rest: httpx.Client) -> None:
    headers = {"Idempotency-Key": "order-67"}
    first = rest.post("/v1/refinements", files=multipart(), headers=headers)
    again = rest.post("/v1/refinements", files=multipart(), headers=headers)
    assert "Idempotency-Replayed" not in first.headers
    assert again.headers["Idempotency-Replayed"] == "true"
    assert again.json() == first.json()
    bad = rest.post("/v1/refinements", files=multipart(), headers={"Idempotency-Key": "k" * 256})
    assert (bad.status_code, bad.json()["reason"]) == (422, "INPUT_INVALID")


def post_and_run(rest: httpx.Client, hand: Hand, headers: dict[str, str], act: str) -> httpx.Response:
    """Post with a wait while another thread runs the job."""

    def work() -> None:
        deadline = time.monotonic() + 30
        while not (queued := hand.redis.zrange(keys.QUEUED, 0, -1)):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        job = hand.start(str(queued[0]))
        if act == "finish":
            hand.finish(job, {"refined.glb": b"glTF refined", "report.json": b"{}"})
        else:
            hand.store.fail(job, MeshInvalid("expected triangles, got none"))

    worker = threading.Thread(target=work)
    worker.start()
    answer = rest.post("/v1/refinements", files=multipart(), headers=headers)
    worker.join()
    return answer


def test_waiting_for_the_end(rest: httpx.Client, hand: Hand) -> None:
    answer = post_and_run(rest, hand, {"Prefer": "wait=30"}, "finish")
    assert (answer.status_code, answer.json()["state"]) == (200, "succeeded")
    assert answer.headers["Preference-Applied"] == "wait=30"
    assert [a["name"] for a in answer.json()["artifacts"]] == ["refined.glb", "report.json"]
    for artifact in answer.json()["artifacts"]:
        assert rest.get(artifact["url"]).status_code == 200


def test_waiting_for_the_mesh_itself(rest: httpx.Client, hand: Hand) -> None:
    headers = {"Prefer": "respond-async, wait=30", "Accept": "model/gltf-binary"}
    answer = post_and_run(rest, hand, headers, "finish")
    assert (answer.status_code, answer.content) == (200, b"glTF refined")
    assert answer.headers["Content-Type"] == "model/gltf-binary"
    assert rest.get(answer.headers["Location"]).json()["state"] == "succeeded"


def test_waiting_for_the_mesh_of_a_job_that_fails(rest: httpx.Client, hand: Hand) -> None:
    headers = {"Prefer": "wait=30", "Accept": "model/gltf-binary"}
    answer = post_and_run(rest, hand, headers, "fail")
    assert (answer.status_code, answer.json()["reason"]) == (422, "MESH_INVALID")


@pytest.mark.parametrize("wait", [{"Prefer": "wait=1"}, {"Prefer": "wait=0"}])
def test_a_mesh_that_is_not_ready_is_no_success(rest: httpx.Client, hand: Hand, wait: dict[str, str]) -> None:
    """What curl writes to refined.glb is the mesh, or curl --fail writes nothing."""
    headers = {**wait, "Accept": "model/gltf-binary", "Idempotency-Key": "the same"}
    answer = rest.post("/v1/refinements", files=multipart(), headers=headers)
    assert (answer.status_code, answer.json()["reason"]) == (406, "NOT_READY")
    assert answer.headers["Content-Type"] == "application/problem+json"
    refinement_id = answer.headers["Location"].rpartition("/")[2]
    assert rest.get(answer.headers["Location"]).json()["state"] == "queued"
    hand.run(refinement_id, {"refined.glb": b"glTF refined"})
    again = rest.post("/v1/refinements", files=multipart(), headers=headers)
    assert (again.status_code, again.content) == (200, b"glTF refined")


def test_who_wants_the_mesh_waits_without_saying_so(rest: httpx.Client, hand: Hand) -> None:
    answer = post_and_run(rest, hand, {"Accept": "model/gltf-binary"}, "finish")
    assert (answer.status_code, answer.content) == (200, b"glTF refined")


def test_who_takes_json_too_gets_it(rest: httpx.Client) -> None:
    headers = {"Prefer": "wait=0", "Accept": "model/gltf-binary, application/json;q=0.5"}
    answer = rest.post("/v1/refinements", files=multipart(), headers=headers)
    assert (answer.status_code, answer.json()["state"]) == (202, "queued")


def test_waiting_too_short(rest: httpx.Client) -> None:
    answer = rest.post("/v1/refinements", files=multipart(), headers={"Prefer": "wait=1"})
    assert (answer.status_code, answer.json()["state"]) == (202, "queued")
    assert answer.headers["Preference-Applied"] == "wait=1"
