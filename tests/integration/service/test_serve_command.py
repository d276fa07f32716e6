"""`refine serve`: everything in one command, with real workers, and nothing left behind."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import psutil
import pytest
from serve_process import serve

from refine_client import RefineClient
from refine_proto.models import State

pytest.importorskip("refine_worker")
SAMPLE = Path(__file__).parents[3] / "examples/samples/chair"


def test_a_job_and_a_clean_stop(tmp_path: Path) -> None:
    with serve(tmp_path) as served:
        assert [line.split()[0] for line in served.lines] == ["REST", "gRPC", "data", "slots", "ready"]
        assert "1 on cpu" in served.lines[-1]
        family = served.family()
        assert len(family) >= 3  # Redis, service, worker
        with RefineClient(served.url) as client:
            camera = json.loads((SAMPLE / "camera.json").read_text())
            refinement = client.submit(
                SAMPLE / "coarse.obj",
                SAMPLE / "silhouette.png",
                camera,
                {"preset": "fast", "iterations": 2},
            )
            ended = client.wait(refinement.id, timeout_s=300)
        assert ended.state is State.SUCCEEDED, ended.error
        opened = [file for file in (tmp_path, *tmp_path.rglob("*")) if file.stat().st_mode & 0o077]
        assert opened == []  # to other users of the machine
        served.process.send_signal(signal.SIGINT)
        assert served.process.wait(90) == 0
        assert [process for process in family if process.is_running()] == []


def test_a_process_that_dies_ends_all(tmp_path: Path) -> None:
    with serve(tmp_path) as served:
        family = served.family()
        own = psutil.Process(served.process.pid).children()
        [worker] = [process for process in own if "refine_worker" in process.cmdline()]
        worker.kill()
        assert served.process.wait(90) == 1
        assert served.process.stderr is not None
        assert "error: the worker ended with code -9" in served.process.stderr.read()
        psutil.wait_procs(family, timeout=30)
        assert [process for process in family if process.is_running()] == []


def test_an_engine_that_cannot_start_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "torch").mkdir()
    (tmp_path / "torch/__init__.py").write_text("raise ImportError('a library of the driver is missing')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with serve(tmp_path / "data") as served:
        assert served.process.wait(90) == 1
        assert served.process.stderr is not None
        told = served.process.stderr.read()
    assert "error: the worker ended with code 1" in told
    assert "ImportError: a library of the driver is missing" in told
    assert "no slot could start its engine process" in told


def test_a_killed_serve_leaves_nothing_running(tmp_path: Path) -> None:
    with serve(tmp_path) as served, RefineClient(served.url) as client:
        family = served.family()
        camera = json.loads((SAMPLE / "camera.json").read_text())
        job = client.submit(
            SAMPLE / "coarse.obj", SAMPLE / "silhouette.png", camera, {"preset": "fast", "iterations": 2}
        )
        served.process.kill()
        served.process.wait()
        _, alive = psutil.wait_procs(family, timeout=90)
        assert alive == []
    with serve(tmp_path) as served, RefineClient(served.url) as client:  # which finds the data
        assert served.lines[-1].startswith("ready")
        ended = client.wait(job.id, timeout_s=300)
        assert (ended.state, ended.attempt) == (State.SUCCEEDED, 1), ended.error
        served.process.send_signal(signal.SIGTERM)
        assert served.process.wait(90) == 0


def test_one_serve_per_folder(tmp_path: Path) -> None:
    with serve(tmp_path), serve(tmp_path) as second:
        assert second.process.wait(30) == 2
        assert second.process.stderr is not None
        assert "another process is using" in second.process.stderr.read()
