"""The same calls, sync and async, over REST and gRPC, give the same values and the same errors."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest
from faces import Face
from judgement import ESTIMATE
from server_double import ARTIFACTS, STEPS, Script

from refine_client import AsyncRefineClient, ConnectionLost, RefineClient, RetryPolicy, View
from refine_proto import errors
from refine_proto.errors import RefineError
from refine_proto.models import EventType, FieldError, Progress, State

Camera = dict[str, Any]


def test_submit_sends_everything(
    face: Face, script: Script, mesh: Path, silhouette: Path, camera: Camera
) -> None:
    options = {"preset": "fast", "iterations": 20}
    refinement = face.call("submit", mesh, silhouette, camera, options, idempotency_key="key-of-mine")
    assert (refinement.id, refinement.state, refinement.queue_position) == ("job-1", State.QUEUED, 3)
    assert refinement.options.iterations == 20
    upload = script.uploads["key-of-mine"]
    assert upload["mesh"] == mesh.read_bytes()
    assert upload["silhouette"] == silhouette.read_bytes()
    assert upload["camera"] == {**camera, "fov_y_degrees": 60, "roll_degrees": 0}
    assert upload["options"]["preset"] == "fast"
    assert upload["mesh_format"] == "obj"
    (call,) = script.calls
    assert call.authorization == "Bearer key-1"
    assert len(call.request_id) == 32


def test_submit_names_who_is_told_of_the_end(face: Face, script: Script, camera: Camera) -> None:
    webhook = {"url": "https://example.com/hook", "events": ["failed"]}
    face.call("submit", b"mesh", b"png", camera, webhook=webhook, idempotency_key="with")
    assert script.uploads["with"]["webhook"] == webhook
    face.call("submit", b"mesh", b"png", camera, idempotency_key="without")
    assert "webhook" not in script.uploads["without"]
    with pytest.raises(errors.InvalidInput, match="expected an address"):
        face.call("submit", b"mesh", b"png", camera, webhook={"url": "example.com"})


def test_submit_names_the_addresses_of_files(face: Face, script: Script, camera: Camera) -> None:
    mesh, side = "https://example.com/a.ply?key=b", "https://example.com/side.png"
    face.call("submit", mesh, b"png", camera, views=[View(side, camera)])
    (upload,) = script.uploads.values()
    assert (upload["mesh_url"], upload["silhouette_2_url"], upload["silhouette"]) == (mesh, side, b"png")
    assert (upload["mesh_format"], "mesh" in upload) == ("ply", False)


def test_submit_takes_contents_too(face: Face, script: Script, camera: Camera) -> None:
    face.call("submit", b"glTF...", b"png", camera)
    (upload,) = script.uploads.values()
    assert (upload["mesh"], upload["silhouette"]) == (b"glTF...", b"png")
    assert "mesh_format" not in upload


def test_validate_sends_the_same_and_gets_what_looks_wrong(
    face: Face, script: Script, mesh: Path, silhouette: Path, camera: Camera
) -> None:
    script.failures = [errors.Unavailable("all slots are busy", retry_after_s=0.01)]
    validation = face.call("validate", mesh, silhouette, camera, {"checks": "strict"})
    assert (validation.accepted, validation.silhouette_iou) == (True, 0.3)
    assert validation.warnings == ["2 of 9 triangles", "expected more"]
    assert [finding.code for finding in validation.checks] == ["LOW_OVERLAP"]
    upload = script.uploads[""]
    assert (upload["mesh"], upload["mesh_format"]) == (mesh.read_bytes(), "obj")
    assert upload["options"]["checks"] == "strict"
    assert [call.name for call in script.calls] == ["validate", "validate"]  # retried while busy


def test_estimate_camera_sends_what_is_known_and_gets_the_camera_to_send(
    face: Face, script: Script, mesh: Path, silhouette: Path
) -> None:
    script.failures = [errors.Unavailable("all slots are busy", retry_after_s=0.01)]
    known = {"azimuth_degrees": 30, "fov_y_degrees": 40}
    assert face.call("estimate_camera", mesh, silhouette, known, ignore=b"hair") == ESTIMATE
    upload = script.uploads[""]
    assert (upload["mesh"], upload["ignore"], upload["mesh_format"]) == (mesh.read_bytes(), b"hair", "obj")
    assert upload["camera"] == {"type": "estimate", **known, "roll_degrees": 0}
    assert [call.name for call in script.calls] == ["estimate", "estimate"]
    face.call("estimate_camera", mesh, silhouette)
    assert script.uploads[""]["camera"] == {"type": "estimate", "roll_degrees": 0}


def test_submit_sends_further_views(face: Face, script: Script, silhouette: Path, camera: Camera) -> None:
    side = camera | {"azimuth_degrees": -80}
    views = [View(b"side", side, b"hand"), View(silhouette, camera)]
    face.call("submit", b"mesh", b"front", camera, ignore=b"hair", views=views)
    (upload,) = script.uploads.values()
    files = ("silhouette", "ignore", "silhouette_2", "ignore_2", "silhouette_3")
    assert [upload[name] for name in files] == [b"front", b"hair", b"side", b"hand", silhouette.read_bytes()]
    assert "ignore_3" not in upload
    assert [view["camera"]["azimuth_degrees"] for view in upload["views"]] == [-80, 30]


def test_a_bad_camera_of_a_further_view_is_refused_before_anything_is_sent(
    face: Face, script: Script, camera: Camera
) -> None:
    with pytest.raises(errors.CameraInvalid) as caught:
        face.call("submit", b"mesh", b"png", camera, views=[View(b"png", camera | {"distance": -1})])
    assert [field.pointer for field in caught.value.errors] == ["/views/0/camera/distance"]
    with pytest.raises(errors.InvalidInput, match="at most 7"):
        face.call("submit", b"mesh", b"png", camera, views=[View(b"png", camera)] * 8)
    assert script.calls == []


def test_get_list_cancel_delete(face: Face, script: Script) -> None:
    assert face.call("get", "job-1") == script.refinement()
    page = face.call("list", limit=1)
    assert ([r.id for r in page.refinements], page.next_cursor) == (["job-1"], "page-2")
    assert face.call("list", cursor=page.next_cursor).next_cursor is None
    assert [r.id for r in face.all("list_all", state="succeeded", metadata={"set": "chairs"})] == [
        "job-1"
    ] * 4
    with pytest.raises(errors.InvalidInput, match="expected one of queued"):
        face.call("list", state=["done"])
    with pytest.raises(errors.InvalidInput, match="pattern"):
        face.call("list", metadata={"no key": ""})
    assert face.call("cancel", "job-1").state is State.CANCELLED
    face.call("delete", "job-1")
    assert script.deleted


def test_an_id_is_one_step_of_the_path(face: Face, script: Script) -> None:
    with pytest.raises(errors.NotFound, match=r"got 'a/\.\./b\?c'"):
        face.call("get", "a/../b?c")


@pytest.mark.parametrize(
    "error",
    [
        errors.MeshInvalid("expected a mesh", errors=[FieldError(pointer="/mesh", detail="empty")]),
        errors.PayloadTooLarge("expected at most 64 MB"),
        errors.IdempotencyKeyReused("expected other content"),
        errors.Unauthenticated("expected a key"),
        errors.Expired("expected a younger one"),
        errors.Conflict("expected another state"),
        errors.UploadTimeout("expected the upload within 300 s"),
        errors.ServerError("a bug"),
    ],
    ids=lambda error: error.reason,
)
def test_errors_are_the_servers_and_not_retried(face: Face, script: Script, error: RefineError) -> None:
    script.failures = [error]
    with pytest.raises(type(error)) as caught:
        face.call("get", "job-1")
    got = caught.value
    assert (got.reason, got.detail, got.errors) == (error.reason, error.detail, error.errors)
    assert not isinstance(got, errors.JobFailed)
    assert got.request_id == script.calls[0].request_id
    assert len(script.calls) == 1


def test_busy_is_retried_after_what_the_server_says(
    face: Face, script: Script, mesh: Path, silhouette: Path, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr("refine_client.client.time.sleep", slept.append)

    async def sleep(delay_s: float) -> None:
        slept.append(delay_s)

    monkeypatch.setattr("refine_client.aio.asyncio.sleep", sleep)
    script.failures = [
        errors.QueueFull("full", retry_after_s=7),
        errors.QuotaExceeded("slow", retry_after_s=0),
    ]
    assert face.call("submit", mesh, silhouette, camera).id == "job-1"
    assert 7 <= slept[0] < 7.1
    assert 0 <= slept[1] < 0.1
    keys = {call.detail for call in script.calls}
    assert (len(script.calls), len(keys)) == (3, 1)
    assert len({call.request_id for call in script.calls}) == 3


def test_retries_end_with_the_last_error(face: Face, script: Script) -> None:
    script.failures = [errors.Draining("going down")] * 9
    with pytest.raises(errors.Draining) as caught:
        face.call("get", "job-1")
    assert len(script.calls) == 5
    assert caught.value.request_id == script.calls[-1].request_id


def test_a_long_retry_after_is_raised_at_once(face: Face, script: Script) -> None:
    script.failures = [errors.QuotaExceeded("tomorrow", retry_after_s=3600)]
    with pytest.raises(errors.QuotaExceeded) as caught:
        face.call("get", "job-1")
    assert caught.value.retry_after_s == 3600
    assert len(script.calls) == 1


def test_a_dropped_answer_is_asked_for_again_with_the_same_key(
    face: Face, script: Script, mesh: Path, silhouette: Path, camera: Camera
) -> None:
    script.failures = [script.drop]
    assert face.call("submit", mesh, silhouette, camera).id == "job-1"
    creates = script.seen("create")
    assert len(creates) >= 2
    assert len({call.detail for call in creates}) == 1
    assert [upload["mesh"] for upload in script.uploads.values()] == [mesh.read_bytes()]


def test_a_delete_whose_answer_was_lost_is_done(face: Face, script: Script) -> None:
    def delete_and_drop() -> None:
        script.deleted = True
        script.drop()

    script.failures = [delete_and_drop]
    face.call("delete", "job-1")
    assert len(script.seen("delete")) == 2


def test_deleting_what_is_not_there_fails(face: Face, script: Script) -> None:
    script.deleted = True
    with pytest.raises(errors.NotFound):
        face.call("delete", "job-1")


def test_watch_gives_every_event_in_order(face: Face, script: Script) -> None:
    events = face.watch("job-1")
    assert [event.sequence for event in events] == list(range(1, STEPS + 4))
    assert [event.type for event in events[1:4]] == [EventType.STATE, EventType.PROGRESS, EventType.PROGRESS]
    assert events[-1].refinement == script.refinement()
    assert len(script.calls) == 1


@pytest.mark.parametrize("how", ["drop", "end"])
def test_watch_survives_lost_connections(face: Face, script: Script, how: Any) -> None:
    script.watch_cuts = [(how, 2), (how, 2), (how, 5), (how, 8)]
    events = face.watch("job-1")
    assert [event.sequence for event in events] == list(range(1, STEPS + 4))
    asked = [call.detail for call in script.seen("watch")]
    assert asked[0] == 0
    assert len(asked) == 5
    assert asked == sorted(asked)
    if how == "end":
        assert asked == [0, 2, 2, 5, 8]


def test_watch_survives_a_server_that_is_away(face: Face, script: Script) -> None:
    script.watch_cuts = [("end", 4)]
    script.failures = [lambda: None, errors.Draining("going down"), errors.Unavailable("not up yet")]
    assert [event.sequence for event in face.watch("job-1")] == list(range(1, STEPS + 4))
    assert [call.detail for call in script.seen("watch")] == [0, 4, 4, 4]


def test_watch_gives_up_without_an_event(face: Face, script: Script) -> None:
    script.watch_cuts = [("end", 0)] * 9
    with pytest.raises(ConnectionLost, match="completed") as caught:
        face.watch("job-1")
    assert len(script.calls) == 5
    assert caught.value.request_id == script.calls[-1].request_id


def test_watch_moves_to_fresh_connections(
    face: Face, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refine_client.follow.LONGEST_CONNECTION_S", 0.1)
    script.hang = True
    timer = threading.Timer(1.0, script.cancelled.set)
    timer.start()
    events = face.watch("job-1")
    timer.join()
    assert [event.sequence for event in events] == list(range(1, STEPS + 4))
    assert events[-1].state is State.CANCELLED
    assert len(script.seen("watch")) > 5  # more than the retries


def test_what_only_a_newer_server_says_is_passed_over(face: Face, script: Script) -> None:
    script.newer, script.ends_in = True, State("stored")
    events = face.watch("job-1")
    assert [event.sequence for event in events] == list(range(1, STEPS + 4))
    assert events[-1].type is EventType.COMPLETED
    assert face.call("get", "job-1").state not in list(State)
    assert face.call("list").refinements[0].state not in list(State)


def test_watch_from_a_sequence_on(face: Face) -> None:
    assert [event.sequence for event in face.watch("job-1", after_sequence=7)] == [8, 9]


def test_watch_of_an_unknown_id_fails(face: Face, script: Script) -> None:
    script.failures = [errors.NotFound("expected an id")]
    with pytest.raises(errors.NotFound):
        face.watch("job-9")


def test_wait_returns_what_became_of_it(face: Face, script: Script) -> None:
    script.ends_in, script.error = State.FAILED, errors.Diverged("loss is not finite")
    refinement = face.call("wait", "job-1")
    assert refinement.state is State.FAILED
    assert refinement.error.reason == "DIVERGED"


def test_wait_has_an_end(face: Face, script: Script) -> None:
    script.hang = True
    with pytest.raises(TimeoutError, match=r"job-1 to end within 0\.3 s"):
        face.call("wait", "job-1", timeout_s=0.3)


def test_refine_does_it_all(
    face: Face, script: Script, mesh: Path, silhouette: Path, camera: Camera, tmp_path: Path
) -> None:
    seen: list[Progress] = []
    refined = face.call("refine", mesh, silhouette, camera, tmp_path / "out", progress=seen.append)
    assert [progress.iteration for progress in seen] == list(range(1, STEPS + 1))
    assert refined.refinement.state is State.SUCCEEDED
    assert refined.refinement.silhouette_iou.after == 0.9
    assert {name: path.read_bytes() for name, path in refined.files.items()} == ARTIFACTS


@pytest.mark.parametrize(
    ("error", "caught_as"),
    [
        (errors.ObjectOutOfView("expected the object in view"), errors.InvalidInput),
        (errors.Internal("the engine crashed"), errors.JobFailed),
        (errors.DeadlineExceeded("expected an end within 60 s"), errors.JobFailed),
    ],
    ids=lambda value: getattr(value, "reason", ""),
)
def test_refine_raises_the_reason_of_the_job(
    face: Face,
    script: Script,
    mesh: Path,
    silhouette: Path,
    camera: Camera,
    tmp_path: Path,
    error: RefineError,
    caught_as: type[RefineError],
) -> None:
    script.ends_in, script.error = State.FAILED, error
    with pytest.raises(caught_as) as caught:
        face.call("refine", mesh, silhouette, camera, tmp_path / "out")
    assert type(caught.value) is type(error)
    assert caught.value.request_id == "req-job"
    assert not script.seen("download")


def test_a_reason_of_a_newer_server_is_kept(face: Face, script: Script) -> None:
    script.failures = [RefineError("new", reason="BRAND_NEW")]
    with pytest.raises(RefineError) as caught:
        face.call("get", "job-1")
    assert (type(caught.value), caught.value.reason) == (RefineError, "BRAND_NEW")


def test_an_interrupted_refine_cancels_its_job(
    face: Face, script: Script, mesh: Path, silhouette: Path, camera: Camera, tmp_path: Path
) -> None:
    script.hang = True

    def stop(progress: Progress) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        face.call("refine", mesh, silhouette, camera, tmp_path / "out", progress=stop)
    assert script.cancelled.is_set()


def test_a_cancelled_task_cancels_its_job(
    server: str, script: Script, camera: Camera, tmp_path: Path
) -> None:
    script.hang = True

    async def main() -> None:
        async with AsyncRefineClient(server) as client:
            running = asyncio.Event()
            task = asyncio.create_task(
                client.refine(b"mesh", b"png", camera, tmp_path, progress=lambda _: running.set())
            )
            await running.wait()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    asyncio.run(main())
    assert script.cancelled.is_set()


@pytest.mark.parametrize(
    ("camera_change", "options", "error", "pointer"),
    [
        ({"azimut": 3}, {}, errors.CameraInvalid, "/camera/azimut"),
        ({"distance": -1}, {}, errors.CameraInvalid, "/camera/distance"),
        ({}, {"iteration": 3}, errors.OptionsInvalid, "/options/iteration"),
        ({}, {"iterations": 0}, errors.OptionsInvalid, "/options/iterations"),
    ],
)
def test_bad_input_is_found_before_it_is_sent(
    face: Face,
    script: Script,
    camera: Camera,
    camera_change: Camera,
    options: dict[str, Any],
    error: type[RefineError],
    pointer: str,
) -> None:
    with pytest.raises(error) as caught:
        face.call("submit", b"mesh", b"png", {**camera, **camera_change}, options)
    assert [field.pointer for field in caught.value.errors] == [pointer]
    assert script.calls == []


def test_a_missing_file_is_an_oserror(face: Face, script: Script, camera: Camera, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        face.call("submit", tmp_path / "no.glb", b"png", camera)
    assert script.calls == []


@pytest.mark.parametrize("scheme", ["http", "grpc"])
def test_nobody_there(scheme: str) -> None:
    with RefineClient(f"{scheme}://127.0.0.1:1", retry=RetryPolicy(retries=0)) as client:
        with pytest.raises(ConnectionLost, match="is the server running") as caught:
            client.get("job-1")
        assert caught.value.reason == "UNAVAILABLE"
        assert caught.value.request_id
