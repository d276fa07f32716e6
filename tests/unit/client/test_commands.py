"""The commands against a real socket: what they print, where, and how they end."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from server_double import ARTIFACTS, STEPS, Script

from refine_client.commands.refinements import (
    cancel_command,
    delete_command,
    download_command,
    get_command,
    list_command,
)
from refine_client.commands.submit import submit_command
from refine_client.commands.validate import validate_command
from refine_client.commands.watch import watch_command
from refine_proto import errors
from refine_proto.checks import Code
from refine_proto.models import Event, Finding, Refinement, Severity, State, Validation

COMMANDS = [
    submit_command,
    validate_command,
    get_command,
    list_command,
    watch_command,
    cancel_command,
    delete_command,
    download_command,
]
Output = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def environment(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REFINE_SERVER", server)
    monkeypatch.setenv("REFINE_API_KEY", "key-1")


@pytest.fixture
def submission(mesh: Path, silhouette: Path, camera: dict[str, Any], tmp_path: Path) -> list[str]:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(camera))
    return [str(mesh), str(silhouette), "--camera", str(path)]


def test_submit_prints_the_id(submission: list[str], script: Script, capsys: Output) -> None:
    more = ["--preset", "fast", "--iterations", "20", "--seed", "3", "--symmetry-normal", "1", "0", "0"]
    assert submit_command([*submission, *more, "--timeout-s", "60", "--idempotency-key", "my-own-key"]) == 0
    assert capsys.readouterr() == ("job-1\n", "")
    options = script.uploads["my-own-key"]["options"]
    assert (options["preset"], options["iterations"], options["seed"]) == ("fast", 20, 3)
    assert (options["symmetry_normal"], options["timeout_s"]) == ([1, 0, 0], 60)
    assert script.calls[0].authorization == "Bearer key-1"


def test_submit_names_who_is_told_of_the_end(submission: list[str], script: Script, capsys: Output) -> None:
    more = ["--webhook-event", "failed", "--webhook-event", "cancelled"]
    assert submit_command([*submission, *more]) == 2
    assert "expected --webhook URL" in capsys.readouterr().err
    assert submit_command([*submission, *more, "--webhook", "https://example.com"]) == 0
    (upload,) = script.uploads.values()
    assert upload["webhook"] == {"url": "https://example.com", "events": ["failed", "cancelled"]}


def test_submit_names_the_addresses_of_files(submission: list[str], script: Script, capsys: Output) -> None:
    mesh, image = "https://example.com//a.ply", "https://example.com/b.png"
    view = ["--view", image, submission[3], image]
    assert submit_command([mesh, image, *submission[2:], *view]) == 0
    (upload,) = script.uploads.values()
    assert [upload[f"{name}_url"] for name in ("mesh", "silhouette", "silhouette_2", "ignore_2")] == [
        mesh, image, image, image
    ]  # fmt: skip


def test_submit_writes_metadata(submission: list[str], script: Script, capsys: Output) -> None:
    assert submit_command([*submission, "--metadata", "set=chairs", "--metadata", "n=1=2"]) == 0
    (upload,) = script.uploads.values()
    assert upload["metadata"] == {"set": "chairs", "n": "1=2"}


def test_validate_prints_what_looks_wrong(submission: list[str], script: Script, capsys: Output) -> None:
    assert validate_command([*submission, "--checks", "strict", "--mesh-format", "obj"]) == 0
    printed, shown = capsys.readouterr()
    assert shown == ""
    assert printed.splitlines() == [
        "can be refined, 2D IoU 0.300",
        "warning LOW_OVERLAP: expected more",
        "warning: 2 of 9 triangles",
    ]
    assert script.uploads[""]["options"]["checks"] == "strict"
    script.severity = Severity.REFUSED
    assert validate_command([*submission, "--json"]) == 2
    validation = Validation.model_validate_json(capsys.readouterr().out)
    assert (validation.accepted, validation.checks[0].severity) == (False, Severity.REFUSED)


def test_submit_wait_and_download(
    submission: list[str], script: Script, tmp_path: Path, capsys: Output
) -> None:
    out = tmp_path / "deep/out"
    assert submit_command([*submission, "--wait", "-o", str(out)]) == 0
    printed, shown = capsys.readouterr()
    assert printed.splitlines()[0] == "job-1 succeeded, 2D IoU 0.500 -> 0.900"
    assert printed.splitlines()[1:] == [str(out / name) for name in ARTIFACTS]
    assert {path.name: path.read_bytes() for path in out.iterdir()} == ARTIFACTS
    lines = shown.splitlines()
    assert lines[0] == "job-1 queued"
    assert lines[1:3] == ["queued", "running"]
    assert lines[3] == f"iteration 1/{STEPS}  0 s left  loss 1.500  2D IoU 0.750"
    assert lines[-1] == "succeeded"


def test_submit_wait_tells_what_looked_wrong(submission: list[str], script: Script, capsys: Output) -> None:
    script.checks = [Finding(code=Code.LOW_OVERLAP, severity=Severity.WARNING, message="expected more")]
    assert submit_command([*submission, "--wait"]) == 0
    assert capsys.readouterr().err.splitlines()[-1] == "warning: expected more"


def test_submit_json_is_events_and_artifacts(
    submission: list[str], script: Script, tmp_path: Path, capsys: Output
) -> None:
    assert submit_command([*submission, "-o", str(tmp_path / "out"), "--json"]) == 0
    printed, shown = capsys.readouterr()
    assert shown == ""
    *lines, last = printed.splitlines()
    events = [Event.model_validate_json(line) for line in lines]
    assert [event.sequence for event in events] == list(range(1, STEPS + 4))
    assert events[-1].refinement == script.refinement()
    files = {name: str(tmp_path / "out" / name) for name in ARTIFACTS}
    assert json.loads(last) == {"type": "artifacts", "artifacts": files}


def test_submit_json_without_waiting_is_the_refinement(submission: list[str], capsys: Output) -> None:
    assert submit_command([*submission, "--json"]) == 0
    assert Refinement.model_validate_json(capsys.readouterr().out).state is State.QUEUED


def test_a_bar_on_a_terminal(submission: list[str], tmp_path: Path) -> None:
    program = (
        "import sys; from refine_client.commands.submit import submit_command;"
        "sys.exit(submit_command(sys.argv[1:]))"
    )
    ours, theirs = pty.openpty()
    shown: list[bytes] = []

    def read() -> None:
        try:
            while portion := os.read(ours, 65536):
                shown.append(portion)
        except OSError:  # how Linux ends a terminal that nobody writes to any more
            return

    reader = threading.Thread(target=read)
    reader.start()
    command = [sys.executable, "-c", program, *submission, "--wait"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=theirs, env=environment, check=True)
    os.close(theirs)
    reader.join()
    os.close(ours)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", b"".join(shown).decode())
    assert f"{STEPS}/{STEPS}" in text
    assert "succeeded" in text
    assert "2D IoU 0.750" in text
    assert done.stdout.decode() == "job-1 succeeded, 2D IoU 0.500 -> 0.900\n"


@pytest.mark.parametrize(
    ("error", "code"), [(errors.Diverged("loss is not finite"), 1), (errors.MeshInvalid("no faces"), 2)]
)
def test_a_failed_job(
    submission: list[str], script: Script, capsys: Output, error: errors.RefineError, code: int
) -> None:
    script.ends_in, script.error = State.FAILED, error
    assert submit_command([*submission, "--wait"]) == code
    printed, shown = capsys.readouterr()
    assert printed == ""
    assert shown.splitlines()[-1] == f"error: {error.reason}: {error.detail} (request req-job)"


def test_a_cancelled_job(script: Script, capsys: Output) -> None:
    script.ends_in = State.CANCELLED
    assert watch_command(["job-1"]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "error: CANCELLED: refinement job-1 was cancelled"


def test_ctrl_c_leaves_the_job_and_says_so(
    submission: list[str], script: Script, capsys: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(self: Any, event: Event) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("refine_proto.commands.display.LineDisplay.event", interrupt)
    with pytest.raises(KeyboardInterrupt):
        submit_command([*submission, "--wait"])
    assert "refine watch job-1, or refine cancel job-1" in capsys.readouterr().err
    assert not script.seen("cancel")


def test_get(script: Script, capsys: Output) -> None:
    assert get_command(["job-1"]) == 0
    shown = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert shown["state"] == "succeeded"
    assert shown["2D"] == "IoU     0.500 -> 0.900"
    assert shown["artifacts"] == "refined.glb, report.json"
    assert get_command(["job-1", "--json"]) == 0
    assert Refinement.model_validate_json(capsys.readouterr().out) == script.refinement()


def test_list_follows_the_pages(script: Script, capsys: Output) -> None:
    assert list_command(["--limit", "3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert re.fullmatch(r"job-1 +\d+ d  succeeded  default  2D IoU 0\.500 -> 0\.900", lines[0])
    assert list_command(["--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [Refinement.model_validate_json(line).id for line in lines] == ["job-1"] * 4


def test_list_says_how_far_and_why_not(script: Script, capsys: Output) -> None:
    script.ends_in = State.RUNNING
    assert list_command(["--limit", "1", "--state", "running", "--metadata", "set=chairs"]) == 0
    assert re.fullmatch(r"job-1 +\d+ d  running    default  0 %\n", capsys.readouterr().out)
    script.ends_in, script.error = State.FAILED, errors.Diverged("expected less, got more")
    assert list_command(["--limit", "1"]) == 0
    assert re.fullmatch(r"job-1 +\d+ d  failed     default  DIVERGED\n", capsys.readouterr().out)
    assert list_command(["--metadata", "chairs"]) == 2
    assert "expected KEY=VALUE, got 'chairs'" in capsys.readouterr().err


def test_watch_fetches_what_a_stopped_submit_left(script: Script, tmp_path: Path, capsys: Output) -> None:
    assert watch_command(["job-1", "-o", str(tmp_path / "out")]) == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == ARTIFACTS
    (tmp_path / "file").write_text("")
    assert watch_command(["job-1", "-o", str(tmp_path / "file")]) != 0
    assert len(script.seen("watch")) == 1


def test_cancel_and_delete(script: Script, capsys: Output) -> None:
    script.hang = True
    assert delete_command(["job-1"]) == 2
    assert capsys.readouterr().err.startswith("error: CONFLICT: expected a refinement that has ended")
    assert cancel_command(["job-1"]) == 0
    assert "cancelled" in capsys.readouterr().out
    assert delete_command(["job-1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"id": "job-1", "deleted": True}
    assert script.deleted


def test_watch_json(capsys: Output) -> None:
    assert watch_command(["job-1", "--json"]) == 0
    types = [json.loads(line)["type"] for line in capsys.readouterr().out.splitlines()]
    assert types == ["state", "state"] + ["progress"] * STEPS + ["completed"]


def test_download(tmp_path: Path, capsys: Output) -> None:
    assert download_command(["job-1", "-o", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "a" / name) for name in ARTIFACTS]
    assert download_command(["job-1", "report.json", "-o", str(tmp_path / "b"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"report.json": str(tmp_path / "b/report.json")}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (["--preset", "best"], "INPUT_INVALID: argument --preset: invalid choice: 'best'"),
        (["--iterations", "0"], "OPTIONS_INVALID: /options/iterations: "),
        (["--idempotency-key", ""], "INPUT_INVALID: expected an idempotency key of 1 to 255"),
        (["--server", "here"], "INPUT_INVALID: expected a server like http://host:8000"),
        (["--camera", "no-such.json"], "INPUT_INVALID: no-such.json: No such file"),
        (["--camera", "/dev/null"], "CAMERA_INVALID: /camera: expected JSON, got b''"),
        (["--output", "/dev/null"], "INPUT_INVALID: /dev/null: File exists"),
        (["--surprise"], "INPUT_INVALID: unrecognized arguments: --surprise; refine submit --help"),
    ],
)
def test_bad_input_is_one_line_and_2(
    submission: list[str], script: Script, capsys: Output, change: list[str], says: str
) -> None:
    assert submit_command([*submission, *change]) == 2
    printed, shown = capsys.readouterr()
    assert printed == ""
    assert shown.startswith(f"error: {says}")
    assert shown.count("\n") == 1
    assert script.calls == []


def test_an_error_has_the_request_id_and_no_control_characters(script: Script, capsys: Output) -> None:
    script.failures = [errors.NotFound("expected one of yours,\n got \x1b[31mred\x07")]
    assert get_command(["job-1"]) == 2
    request_id = script.calls[0].request_id
    line = f"error: NOT_FOUND: expected one of yours, got [31mred (request {request_id})\n"
    assert capsys.readouterr().err == line


def test_a_server_that_fails_is_1(script: Script, capsys: Output) -> None:
    script.failures = [errors.QuotaExceeded("too many", retry_after_s=900)]
    assert get_command(["job-1"]) == 1
    assert capsys.readouterr().err.startswith("error: QUOTA_EXCEEDED: too many (request ")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.__name__)
def test_help_teaches(command: Any, capsys: Output) -> None:
    with pytest.raises(SystemExit) as caught:
        command(["--help"])
    assert caught.value.code == 0
    shown = capsys.readouterr().out
    name = command.__name__.removesuffix("_command")
    assert f"usage: refine {name}" in shown
    assert f"  refine {name}" in shown.partition("example\n")[2]
    assert "REFINE_SERVER" in shown
    assert "exit codes" in shown


def test_submit_sends_views_and_what_is_unknown(
    submission: list[str], script: Script, tmp_path: Path
) -> None:
    camera = submission[-1]
    for name in ("side.png", "hand.png", "hair.png"):
        (tmp_path / name).write_bytes(name.encode())
    side, hand, hair = (str(tmp_path / name) for name in ("side.png", "hand.png", "hair.png"))
    more = ["--ignore", hair, "--view", side, camera, hand, "--view", side, camera, "--ignore-grey", "128"]
    assert submit_command([*submission, *more]) == 0
    (upload,) = script.uploads.values()
    sent = [upload[name] for name in ("ignore", "silhouette_2", "ignore_2", "silhouette_3")]
    assert sent == [b"hair.png", b"side.png", b"hand.png", b"side.png"]
    assert (len(upload["views"]), upload["options"]["ignore_grey"]) == (2, 128)


@pytest.mark.parametrize(
    ("views", "says"),
    [
        ([["side.png"]], "expected --view SILHOUETTE CAMERA.json [IGNORE], got 1 file: side.png"),
        ([["a", "b", "c", "d"]], "got 4 files: a b c d"),
        ([["side.png", "camera.json"]] * 8, "expected at most 8 views, got 9"),
    ],
)
def test_views_that_cannot_be(
    submission: list[str], script: Script, capsys: Output, views: list[list[str]], says: str
) -> None:
    more = [word for paths in views for word in ("--view", *paths)]
    assert submit_command([*submission, *more]) == 2
    assert says in capsys.readouterr().err
    assert script.calls == []


def test_submit_takes_a_frame_of_transforms_json(
    submission: list[str], script: Script, tmp_path: Path
) -> None:
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    frames = [{"file_path": f"./{name}", "transform_matrix": pose} for name in ("r_0", "r_1")]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.5, "frames": frames}))
    assert submit_command([*submission[:-1], f"{tmp_path}/transforms.json#r_1"]) == 0
    (upload,) = script.uploads.values()
    assert upload["camera"]["convention"] == "opengl"
    assert upload["camera"]["fov_x_degrees"] == pytest.approx(28.6479, abs=1e-4)


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ("transforms.json", "expected one camera as"),
        ("missing.json#r_0", "missing.json"),
        ("missing.json", "missing.json"),
    ],
)
def test_camera_files_that_name_no_camera(
    submission: list[str], script: Script, tmp_path: Path, capsys: Output, camera: str, says: str
) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": []}))
    assert submit_command([*submission[:-1], f"{tmp_path}/{camera}"]) == 2
    assert says in capsys.readouterr().err
    assert script.calls == []


def test_a_bad_camera_of_a_view_is_told_where_it_is(
    submission: list[str], tmp_path: Path, capsys: Output
) -> None:
    (tmp_path / "bad.json").write_text(json.dumps({"type": "look_at"}))
    assert submit_command([*submission, "--view", submission[1], f"{tmp_path}/bad.json"]) == 2
    assert "/views/0/camera/azimuth_degrees: expected this required field" in capsys.readouterr().err
