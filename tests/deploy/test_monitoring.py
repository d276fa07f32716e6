"""Rules and dashboard: promtool passes them, and every metric that they name is exported."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from service_process import run_service

from refine_jobs.embedded import EmbeddedRedis

MONITORING = Path(__file__).parents[2] / "deploy/monitoring"
INSTALLATION = "/metrics/installation"
RULES = (MONITORING / "rules.yaml").read_text()
ALERTS = re.findall(r"alert: (\w+)", RULES)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, set[str]]]:
    """What a real service shows, and the names in it."""
    folder = tmp_path_factory.mktemp("monitored")
    with EmbeddedRedis(folder / "redis") as redis, run_service(redis.url, folder / "service") as service:
        with service.rest() as rest:
            rest.get("/v1/refinements")
            text = "".join(rest.get(path).raise_for_status().text for path in ("/metrics", INSTALLATION))
        yield text, set(re.findall(r"^# TYPE (\w+)", text, re.MULTILINE))


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


def test_every_metric_that_is_asked_for_exists(exported: tuple[str, set[str]]) -> None:
    dashboard = json.loads((MONITORING / "dashboard.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    asked = set(
        re.findall(r"\brefine_[a-z_]+", "".join(queries) + " ".join(re.findall("expr:[^#]*?labels", RULES)))
    )
    _, names = exported
    plain = {re.sub(r"_(bucket|count|sum)$", "", name) for name in asked}
    assert len(plain) > 10
    assert plain - names == set()


def test_the_exposition_is_clean(exported: tuple[str, set[str]]) -> None:
    text, _ = exported
    promtool("check", "metrics", given=text)
