"""Many refinements in one call, through a real service: each ends for itself, and a second call goes on."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from faces import AsyncFace, Face, SyncFace
from service_process import CAMERA, MESH, PNG, Hand, Service

from refine_client import AsyncRefineClient, Case, RefineClient, Refined, RetryPolicy, read_cases
from refine_client.commands.submit import submit_command
from refine_jobs import keys
from refine_proto.errors import CameraInvalid, Diverged, InvalidInput, MeshInvalid
from refine_proto.models import Event, State

FILES = {"refined.glb": b"glTF"}
BAD_SEED = 13


@pytest.fixture(params=["sync-rest", "async-grpc"])
def face(service: Service, request: pytest.FixtureRequest) -> Iterator[Face]:
    retry = RetryPolicy(retries=0)
    if request.param == "sync-rest":
        with RefineClient(service.rest_url, retry=retry) as client:
            yield SyncFace(client)
        return
    with asyncio.Runner() as runner:
        aio = AsyncRefineClient(f"grpc://{service.grpc_address}", retry=retry)
        yield AsyncFace(aio, runner)
        runner.run(aio.close())


@contextmanager
def working(hand: Hand) -> Iterator[list[int]]:
    """Inside, queued jobs are run at once, and those with BAD_SEED fail; how many waited at each look."""
    over, seen = threading.Event(), []

    def work() -> None:
        while not over.wait(0.02):
            queued = hand.redis.zrange(keys.QUEUED, 0, -1)
            seen.append(len(queued))
            for job_id in queued:
                job = hand.start(str(job_id))
                if job.spec["options"]["seed"] == BAD_SEED:
                    hand.store.fail(job, Diverged("expected less, got more"))
                else:
                    hand.finish(job, FILES)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield seen
    finally:
        over.set()
        thread.join()


def case(seed: int = 0, mesh: Any = MESH, **more: Any) -> Case:
    return Case(mesh, PNG, more.pop("camera", CAMERA), {"seed": seed}, mesh_format="obj", **more)


def test_each_ends_for_itself(face: Face, hand: Hand, tmp_path: Path) -> None:
    cases = [case(1), case(BAD_SEED), case(mesh=tmp_path / "missing.obj"), case(camera={"type": "look_at"}),
             case(mesh=b""), *[case(n) for n in range(20, 30)]]  # fmt: skip
    told: list[tuple[int, Event]] = []
    with working(hand) as queued:
        found = face.call(
            "refine_many",
            cases,
            tmp_path / "out",
            at_once=3,
            progress=lambda n, event: told.append((n, event)),
        )
    kinds = [type(each) for each in found]
    assert kinds == [Refined, Diverged, FileNotFoundError, CameraInvalid, MeshInvalid, *[Refined] * 10]
    assert found[0].files == {"refined.glb": tmp_path / "out/0001/refined.glb"}
    assert (tmp_path / "out/0015/refined.glb").read_bytes() == b"glTF"
    assert [each.refinement.options.seed for each in found[5:]] == list(range(20, 30))
    assert max(queued) <= 3
    ends = {number: event.state for number, event in told if event.refinement is not None}
    assert ends == {1: State.SUCCEEDED, 2: State.FAILED} | dict.fromkeys(range(6, 16), State.SUCCEEDED)


def test_the_same_key_goes_on_where_it_was(face: Face, hand: Hand, tmp_path: Path) -> None:
    cases = [case(1), case(2, metadata={"set": "chairs"})]
    first = face.call("submit_many", cases, idempotency_key="night run")
    assert [each.state for each in first] == [State.QUEUED] * 2
    assert first[1].metadata == {"set": "chairs"}
    with working(hand):
        second = face.call("refine_many", cases, tmp_path, idempotency_key="night run")
    assert [each.refinement.id for each in second] == [each.id for each in first]
    assert [each.id for each in face.call("submit_many", cases)] != [each.id for each in first]


def test_an_interruption_cancels_what_is_on_its_way(face: Face, hand: Hand, tmp_path: Path) -> None:
    def stop(number: int, event: Event) -> None:
        if number == 2:
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        face.call("refine_many", [case(n) for n in range(9)], tmp_path, at_once=3, progress=stop)
    shown = face.call("list").refinements
    assert {each.state for each in shown} == {State.CANCELLED}
    assert len(shown) <= 4


@pytest.fixture
def batch(tmp_path: Path) -> Path:
    """Two cases that can be refined, and one whose silhouette is missing."""
    (tmp_path / "coarse.obj").write_bytes(MESH)
    (tmp_path / "silhouette.png").write_bytes(PNG)
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    good = {"mesh": "coarse.obj", "silhouette": "silhouette.png", "camera": CAMERA}
    lines = [good | {"camera": "camera.json"}, good | {"silhouette": "missing.png"},
             good | {"views": [{"silhouette": "silhouette.png", "camera": "camera.json"}]}]  # fmt: skip
    path = tmp_path / "cases.jsonl"
    path.write_text("\n\n".join(json.dumps(line) for line in lines))
    return path


def test_the_command(
    service: Service,
    hand: Hand,
    batch: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("REFINE_SERVER", service.rest_url)
    key = ["--idempotency-key", "k", "--batch", str(batch)]
    assert submit_command(key) == 1
    printed, shown = capsys.readouterr()
    lines = [line.split() for line in printed.splitlines()]
    assert [line[0] for line in lines] == ["0001", "0002", "0003"]
    assert (lines[0][2], lines[1][1], lines[2][2]) == ("queued", "error:", "queued")
    assert shown == "2 of 3 cases went well\n"
    with working(hand):
        assert submit_command([*key, "-o", str(tmp_path / "out"), "--json"]) == 1
    results = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [result["refinement"]["id"] for result in (results[0], results[2])] == [lines[0][1], lines[2][1]]
    assert results[0]["files"] == {"refined.glb": str(tmp_path / "out/0001/refined.glb")}
    assert "missing.png" in results[1]["error"]["detail"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "line 2: Expecting"),
        ("[]", "line 2: expected an object"),
        ('{"mesh": "a"}', "line 2: expected the fields mesh, silhouette, camera, .* got no silhouette"),
        ('{"mesh": "a", "silhouette": "b", "camera": {}, "sead": 1}', "got 'sead'"),
        ('{"mesh": 1, "silhouette": "b", "camera": {}}', "expected mesh to be a path"),
        ('{"mesh": "a", "silhouette": "b", "camera": {}, "views": [{}]}', "expected views with silhouette"),
    ],
)
def test_a_line_that_cannot_be_read_is_named(batch: Path, line: str, says: str) -> None:
    batch.write_text(f"{batch.read_text().splitlines()[0]}\n{line}\n")
    with pytest.raises(InvalidInput, match=says):
        read_cases(batch)
