"""What a key lets its owner do, for how long, and how one follows another while the service runs."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
from service_process import CAMERA, MESH, PNG, Service, run_service

from refine_client import RefineClient
from refine_proto.errors import Forbidden, Unauthenticated
from refine_service.edge.auth import ApiKeys, Scope


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("keys")


@pytest.fixture
def keys(folder: Path) -> ApiKeys:
    return ApiKeys(folder / "keys.json")


@pytest.fixture(scope="module")
def shared_service(redis_url: str, folder: Path) -> Iterator[Service]:
    with run_service(redis_url, folder, {"require_key": "true", "metrics_need_key": "true"}) as service:
        yield service


def submit(client: RefineClient) -> str:
    return client.submit(MESH, PNG, CAMERA, mesh_format="obj").id


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_scopes(service: Service, keys: ApiKeys, transport: str) -> None:
    reads, submits = (keys.add("ann", [scope])[1] for scope in (Scope.READ, Scope.SUBMIT))
    with service.client(transport, reads) as reader, service.client(transport, submits) as writer:
        refinement_id = submit(writer)
        assert reader.get(refinement_id).id == refinement_id
        for refused in (
            lambda: submit(reader),
            lambda: reader.cancel(refinement_id),
            lambda: reader.delete(refinement_id),
            lambda: writer.get(refinement_id),
            lambda: next(writer.watch(refinement_id)),
        ):
            with pytest.raises(Forbidden, match="expected an API key with the scope"):
                refused()
        assert writer.cancel(refinement_id).state == "cancelled"


@pytest.mark.parametrize("path", ["/metrics", "/metrics/installation"])
def test_metrics_behind_a_key(rest: httpx.Client, keys: ApiKeys, path: str) -> None:
    scraper, user = keys.add("prometheus", [Scope.ADMIN])[1], keys.add("ann")[1]
    answers = [rest.get(path, headers={"Authorization": f"Bearer {key}"}) for key in (scraper, user)]
    assert [answer.status_code for answer in (rest.get(path), *answers)] == [401, 200, 403]


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_a_key_expires(service: Service, keys: ApiKeys, transport: str) -> None:
    past, future = (datetime.now(UTC) + timedelta(hours=hours) for hours in (-1, 1))
    with service.client(transport, keys.add("ann", expires_at=future)[1]) as client:
        client.list()
    expired = service.client(transport, keys.add("ann", expires_at=past)[1])
    with expired, pytest.raises(Unauthenticated, match="expired"):
        expired.list()


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_one_key_follows_another(service: Service, keys: ApiKeys, transport: str) -> None:
    old, secret = keys.add("ann", [Scope.READ])
    new = keys.rotate(old.id, timedelta(hours=1))
    assert new is not None
    assert new[0].scopes == (Scope.READ,)
    for each in (secret, new[1]):
        with service.client(transport, each) as client:
            client.list()
    keys.rotate(old.id, timedelta(hours=-1))
    with service.client(transport, secret) as client, pytest.raises(Unauthenticated, match="expired"):
        client.list()


def test_a_damaged_file_leaves_the_keys_in_force(service: Service, keys: ApiKeys, folder: Path) -> None:
    secret = keys.add("ann")[1]
    file = folder / "keys.json"
    good = file.read_bytes()
    with service.rest(secret) as rest:
        assert rest.get("/v1/refinements").status_code == 200
        file.write_text("{oops")
        assert [rest.get("/v1/refinements").status_code for _ in range(3)] == [200] * 3
        told = [line for line in service.log() if "keys of before stay in force" in line["message"]]
        assert [line["level"] for line in told] == ["error"]
        file.write_bytes(good)
        assert rest.get("/v1/refinements").status_code == 200


def test_a_service_does_not_start_without_its_keys(tmp_path: Path) -> None:
    (tmp_path / "keys.json").write_text("{oops")
    environment = {**os.environ, "REFINE_REDIS_URL": "redis://127.0.0.1:1", "REFINE_HTTP_PORT": "0"}
    command = [sys.executable, "-m", "refine_service", "--data-folder", str(tmp_path)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "expected a file written by `refine keys`" in ended.stderr


def test_the_command(folder: Path) -> None:
    program = (
        "import sys; from refine_service.commands.keys import keys_command as c; sys.exit(c(sys.argv[1:]))"
    )

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", program, "--data-folder", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    assert run("add", "eve", "--scope", "read", "--expires-days", "30").returncode == 0
    line = run("list").stdout.splitlines()[-1]
    assert "eve  read  normal  until " in line
    assert run("rotate", line.split()[0], "--overlap-hours", "1").stdout.startswith("refine_")
    assert len([line for line in run("list").stdout.splitlines() if "eve  read" in line]) == 2
    assert run("rotate", "nobody").returncode == 1
    assert run("add", "eve", "--scope", "root").returncode == 2
