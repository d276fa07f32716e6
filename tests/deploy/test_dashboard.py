"""Every query of the dashboard, asked of a real Prometheus that scraped a `refine serve` which ran a job."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from serve_process import serve

from refine_client import RefineClient
from refine_proto.models import State

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "examples/samples/chair"
PANELS = json.loads((ROOT / "deploy/monitoring/dashboard.json").read_text())["panels"]
EMPTY = {  # what a healthy installation without a limit of memory and without a card does not show
    '60 * sum by (reason) (rate(refine_jobs_total{state="failed"}[5m])) > 0',
    "max(refine_redis_max_memory_bytes) > 0",
    "max by (instance, device) (refine_worker_gpu_memory_used_bytes)",
    "max by (instance, device) (refine_worker_gpu_memory_size_bytes)",
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def query(prometheus: httpx.Client, expression: str) -> list[dict[str, Any]]:
    answer = prometheus.get("/query", params={"query": expression}).raise_for_status().json()
    assert answer["status"] == "success", answer
    return list(answer["data"]["result"])


def wait_for_sample(prometheus: httpx.Client, expression: str) -> None:
    for _ in range(300):
        try:
            if query(prometheus, expression):
                return
        except httpx.HTTPError:
            pass  # it starts
        time.sleep(0.2)
    raise AssertionError(f"expected a value of {expression}, got none within a minute")


@pytest.fixture(scope="module")
def prometheus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Scraping every second, after one job has ended."""
    binary = shutil.which("prometheus")
    if binary is None:
        pytest.skip("prometheus is not on PATH; on Debian: apt-get install prometheus")
    folder, port, worker_port = tmp_path_factory.mktemp("prometheus"), free_port(), free_port()
    settings = {"worker_port": str(worker_port)}
    with serve(folder / "served", settings) as served, RefineClient(served.url) as client:
        address = urlsplit(served.url).netloc
        asked_for = {
            "refine-service": ("/metrics", address),
            "refine-worker": ("/metrics", f"127.0.0.1:{worker_port}"),
            "refine-installation": ("/metrics/installation", address),
        }
        jobs = [
            {"job_name": name, "metrics_path": path, "static_configs": [{"targets": [target]}]}
            for name, (path, target) in asked_for.items()
        ]
        rules = str(ROOT / "deploy/monitoring/rules.yaml")
        scraping = {"global": {"scrape_interval": "1s"}, "scrape_configs": jobs, "rule_files": [rules]}
        (folder / "prometheus.json").write_text(json.dumps(scraping))  # JSON is YAML
        with (folder / "log").open("w") as log:
            options = (
                f"--config.file={folder}/prometheus.json --storage.tsdb.path={folder}/data "
                f"--web.listen-address=127.0.0.1:{port}"
            )
            process = subprocess.Popen([binary, *options.split()], stdout=log, stderr=log)
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}/api/v1", timeout=30) as asked:
                for counter in ("refine_jobs_total", "refine_worker_attempts_total"):
                    wait_for_sample(asked, f"rate({counter}[5m])")  # before the job, or it is no increase
                sent = client.submit(
                    SAMPLE / "coarse.obj",
                    SAMPLE / "silhouette.png",
                    json.loads((SAMPLE / "camera.json").read_text()),
                    {"iterations": 10},
                )
                assert client.wait(sent.id, timeout_s=300).state is State.SUCCEEDED
                for counter in ("refine_jobs_total", "refine_worker_attempts_total"):
                    wait_for_sample(asked, f"increase({counter}[5m]) > 0")
                wait_for_sample(asked, "rate(refine_worker_stage_seconds_bucket[5m])")
                yield asked
        finally:
            process.terminate()
            process.wait(30)
            served.process.send_signal(signal.SIGINT)  # so that its Redis ends too
            served.process.wait(90)


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel["title"])
def test_a_panel_shows_something(prometheus: httpx.Client, panel: dict[str, Any]) -> None:
    for target in panel["targets"]:
        if target["expr"] not in EMPTY:
            assert query(prometheus, target["expr"]), target["expr"]


def test_a_healthy_installation_rings_no_alarm(prometheus: httpx.Client) -> None:
    assert query(prometheus, 'ALERTS{alertstate="firing"}') == []
