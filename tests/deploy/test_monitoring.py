"""Rules and dashboard: promtool passes them, and every metric that they name is exported."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
from pathlib import Path

import httpx
import pytest
from serve_process import serve

MONITORING = Path(__file__).parents[2] / "deploy/monitoring"
INSTALLATION = "/metrics/installation"
RULES = (MONITORING / "rules.yaml").read_text()
ALERTS = re.findall(r"alert: (\w+)", RULES)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], set[str]]:
    """What a real service and a real worker show, and the names in it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with serve(tmp_path_factory.mktemp("monitored"), {"worker_port": str(port)}) as served:
        httpx.get(f"{served.url}/v1/refinements").raise_for_status()
        pages = [f"{served.url}/metrics", f"{served.url}{INSTALLATION}", f"http://127.0.0.1:{port}/metrics"]
        texts = [httpx.get(page).raise_for_status().text for page in pages]
        served.process.send_signal(signal.SIGINT)  # so that its Redis ends too
        served.process.wait(90)
    return texts, {name for text in texts for name in re.findall(r"^# TYPE (\w+)", text, re.MULTILINE)}


def promtool(*words: str | Path, given: str = "") -> None:
    found = shutil.which("promtool")
    if found is None:
        pytest.skip("promtool is not on PATH; on Debian: apt-get install prometheus")
    answer = subprocess.run([found, *words], input=given, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr


def test_rules() -> None:
    promtool("check", "rules", MONITORING / "rules.yaml")


def test_alerts_fire_on_their_faults() -> None:
    promtool("test", "rules", MONITORING / "rules_test.yaml")


@pytest.mark.parametrize("alert", ALERTS)
def test_an_alert_has_a_test_and_a_page(alert: str) -> None:
    assert alert in (MONITORING / "rules_test.yaml").read_text()
    assert f"runbook.md#{alert.lower()}\n" in RULES
    assert f"\n## {alert}\n" in (MONITORING.parent / "runbook.md").read_text()


def test_every_metric_that_is_asked_for_exists(exported: tuple[list[str], set[str]]) -> None:
    dashboard = json.loads((MONITORING / "dashboard.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked = set(
        re.findall(r"\brefine_[a-z_]+", "".join(queries) + " ".join(re.findall("expr:[^#]*?labels", RULES)))
    )
    _, names = exported
    plain = {re.sub(r"_(bucket|count|sum)$", "", name) for name in asked}
    assert len(plain) > 10
    assert plain - names == set()


def test_the_exposition_is_clean(exported: tuple[list[str], set[str]]) -> None:
    texts, _ = exported
    for text in texts:
        promtool("check", "metrics", given=text)
