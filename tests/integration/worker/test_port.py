"""What a worker tells whoever watches its machine: probes, as HTTP and as a command, and metrics."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import httpx
import psutil
import pytest
from prometheus_client.parser import text_string_to_metric_families
from worker_process import wait_until

from refine_jobs.slots import SlotState
from refine_proto.models import State

if TYPE_CHECKING:
    from worker_process import StartWorker, Worker, Workplace

LONG = 10_000  # iterations; nobody waits for their end


@pytest.fixture
def port() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


@pytest.fixture
def watched(start_worker: StartWorker, own_workplace: Workplace, port: str) -> Iterator[Worker]:
    with start_worker(own_workplace, worker_port=port, slot_timeout_s="3", stop_grace_s="60") as worker:
        yield worker


@pytest.fixture
def http(port: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30) as client:
        yield client


def check(probe: str, port: str | None) -> tuple[int, str]:
    """Exit code and what is printed."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("REFINE_")}
    if port:
        environment["REFINE_WORKER_PORT"] = port
    command = [sys.executable, "-m", "refine_worker", "--check", probe]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, (done.stdout + done.stderr).strip()


def values(http: httpx.Client) -> dict[tuple[str, ...], float]:
    """By name and values of the labels, in the order of their names."""
    return {
        (sample.name, *(sample.labels[label] for label in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(http.get("/metrics").text)
        for sample in family.samples
    }


def test_a_warm_worker_is_live_and_ready_until_it_drains(
    watched: Worker, own_workplace: Workplace, http: httpx.Client, port: str
) -> None:
    wait_until(lambda: http.get("/readyz").status_code == 200, "readiness")
    assert http.get("/readyz").text == "ready: 1 of 1 slots can work\n"
    assert check("ready", port) == (0, "ready: 1 of 1 slots can work")
    assert check("live", port) == (0, "live")
    job_id = own_workplace.submit(iterations=LONG)
    own_workplace.refining(job_id)
    watched.process.terminate()
    wait_until(lambda: http.get("/readyz").status_code == 503, "the drain")
    assert check("ready", port) == (1, "not ready: stopping")
    assert check("live", port) == (0, "live")
    own_workplace.cancel(job_id)
    assert watched.process.wait(60) == 0
    assert check("live", port)[0] == 1
    assert own_workplace.job(job_id).state is State.CANCELLED


def test_a_slot_that_hangs_makes_a_worker_unready_and_not_dead(
    watched: Worker, http: httpx.Client, port: str
) -> None:
    """Its supervisor mends that; a restart of the whole worker would cost the other slots their jobs."""
    wait_until(lambda: http.get("/readyz").status_code == 200, "readiness")
    psutil.Process(watched.slot_pid()).suspend()
    wait_until(lambda: values(http)["refine_worker_slot_restarts_total", "hung", "cpu"] == 1, "a new slot")
    assert http.get("/livez").status_code == 200
    assert check("ready", port) == (1, "not ready: 0 of 1 slots can work")
    wait_until(lambda: http.get("/readyz").status_code == 200, "readiness")


def test_a_supervisor_that_hangs_does_not_answer(watched: Worker, port: str) -> None:
    supervisor = psutil.Process(watched.process.pid)
    supervisor.suspend()
    try:
        code, line = check("live", port)
        assert (code, line.startswith("not live: no worker answers")) == (1, True)
    finally:
        supervisor.resume()


def test_the_metrics_of_a_worker(watched: Worker, own_workplace: Workplace, http: httpx.Client) -> None:
    own_workplace.ended(own_workplace.submit(iterations=4, preset="fast"))
    own_workplace.ended(own_workplace.submit(b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n"))
    job_id = own_workplace.submit(iterations=LONG)
    own_workplace.refining(job_id)
    os.kill(watched.engine_pids()[-1], signal.SIGKILL)
    own_workplace.refining(job_id, attempt=2)
    own_workplace.cancel(job_id)
    own_workplace.ended(job_id)
    counted = wait_until(
        lambda: (now := values(http))["refine_worker_attempts_total", "cpu", "cancelled"] and now, "the count"
    )
    attempts = {
        name[-1]: value for name, value in counted.items() if name[0] == "refine_worker_attempts_total"
    }
    assert attempts == {"succeeded": 1, "failed": 1, "lost": 1, "cancelled": 1, "returned": 0}
    assert counted["refine_worker_engine_starts_total", "cpu"] == 2
    assert counted["refine_worker_engine_restarts_total", "died", "cpu"] == 1
    assert counted["refine_worker_engine_start_seconds_count", "cpu"] == 2
    for stage in ("fetch", "read", "refine", "store"):
        assert counted["refine_worker_stage_seconds_count", "cpu", "fast", stage] == 1
    assert counted["refine_worker_stage_seconds_count", "cpu", "default", "read"] == 3
    assert counted["refine_worker_stage_seconds_count", "cpu", "default", "refine"] == 2
    states = [*map(str, SlotState), "stopped"]
    assert sum(counted["refine_worker_slots", "cpu", state] for state in states) == 1


@pytest.mark.skipif(not shutil.which("promtool"), reason="promtool is not installed (Debian: prometheus)")
def test_promtool_has_nothing_to_say(watched: Worker, own_workplace: Workplace, http: httpx.Client) -> None:
    own_workplace.ended(own_workplace.submit(iterations=4))
    command = ["promtool", "check", "metrics"]
    text = http.get("/metrics").text
    told = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    assert (told.returncode, told.stdout + told.stderr) == (0, "")


def test_the_port_serves_nothing_else(watched: Worker, http: httpx.Client) -> None:
    assert http.get("/").status_code == http.get("/livez/../etc").status_code == 404
    assert http.post("/metrics").status_code == 501


def test_a_port_that_is_taken_is_told(own_workplace: Workplace) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        environment = {**os.environ, **own_workplace.environment, "REFINE_WORKER_PORT": port}
        environment["REFINE_DEVICES"] = "cpu"
        command = [sys.executable, "-m", "refine_worker"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "expected a free port, cannot listen on 127.0.0.1" in done.stderr


def test_a_check_without_a_port_says_what_it_needs() -> None:
    code, line = check("ready", None)
    assert code == 2
    assert "expected REFINE_WORKER_PORT" in line


def test_a_check_loads_neither_redis_nor_the_worker() -> None:
    """It is made every few seconds."""
    program = "import sys, refine_worker.command; print(*sys.modules)"
    loaded = set(
        subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        ).stdout.split()
    )
    assert not loaded & {"redis", "rq", "obstore", "refine_worker.supervisor"}
