"""API keys, owners and the limits of each."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import grpc
import httpx
import pytest
from redis import Redis
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_client import RefineClient
from refine_proto.errors import NotFound, OptionsInvalid, QueueFull, QuotaExceeded, Unauthenticated
from refine_proto.models import Priority
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub
from refine_service.edge.auth import ApiKeys, CallRate
from refine_service.settings import ServiceSettings


def refine_keys(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`refine keys`, as its entry point runs it."""
    program = (
        "import sys; from refine_service.commands.keys import keys_command as c; sys.exit(c(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "--data-folder", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def make_key(folder: Path, owner: str) -> str:
    return refine_keys(folder, "add", owner).stdout.strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("keys")


@pytest.fixture(scope="module")
def shared_service(redis_url: str, folder: Path) -> Iterator[Service]:
    settings = {"require_key": "true", "requests_per_s": 25, "max_queued": 5, "max_queued_per_owner": 3}
    with run_service(redis_url, folder, settings) as service:
        yield service


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_keys_come_and_go_while_the_service_runs(service: Service, folder: Path, transport: str) -> None:
    key = make_key(folder, "ann")
    with service.client(transport, key) as client:
        assert client.list().refinements == []
        listed = refine_keys(folder, "list").stdout
        assert key not in listed
        key_id = listed.splitlines()[-1].split()[0]
        assert refine_keys(folder, "revoke", key_id).returncode == 0
        with pytest.raises(Unauthenticated):
            client.list()
    assert refine_keys(folder, "revoke", key_id).returncode == 1


def test_no_key_and_wrong_keys(service: Service, rest: httpx.Client) -> None:
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic YTpi"}):
        answer = rest.get("/v1/refinements", headers=headers)
        assert (answer.status_code, answer.json()["reason"]) == (401, "UNAUTHENTICATED")
        assert answer.headers["WWW-Authenticate"] == "Bearer"
    with grpc.insecure_channel(service.grpc_address) as channel, pytest.raises(grpc.RpcError) as caught:
        RefinementsStub(channel).ListRefinements(pb.ListRefinementsRequest())
    assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED


def test_what_needs_no_key(rest: httpx.Client) -> None:
    for path in ("/livez", "/metrics", "/openapi.json", "/docs"):
        assert rest.get(path).status_code == 200


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_another_owners_refinement_is_not_there(
    service: Service, hand: Hand, folder: Path, transport: str, tmp_path: Path
) -> None:
    ann, ben = make_key(folder, "ann"), make_key(folder, "ben")
    with service.client(transport, ann) as mine, service.client(transport, ben) as others:
        refinement = mine.submit(MESH, PNG, CAMERA, mesh_format="obj", idempotency_key="the same")
        assert hand.start(refinement.id).owner == "ann"
        assert others.list().refinements == []
        for call in (others.get, others.cancel, others.delete):
            with pytest.raises(NotFound):
                call(refinement.id)
        with pytest.raises(NotFound):
            list(others.watch(refinement.id))
        with pytest.raises(NotFound):
            others.download(refinement.id, tmp_path)
        # Keys of one owner say nothing to another.
        theirs = others.submit(MESH, PNG, CAMERA, mesh_format="obj", idempotency_key="the same")
        assert theirs.id != refinement.id


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_queued_jobs_are_bounded(service: Service, folder: Path, transport: str) -> None:
    with (
        service.client(transport, make_key(folder, "ann")) as ann,
        service.client(transport, make_key(folder, "ben")) as ben,
    ):
        for _ in range(3):
            ann.submit(MESH, PNG, CAMERA, mesh_format="obj")
        with pytest.raises(QuotaExceeded) as quota:
            ann.submit(MESH, PNG, CAMERA, mesh_format="obj")
        for _ in range(2):
            ben.submit(MESH, PNG, CAMERA, mesh_format="obj")
        with pytest.raises(QueueFull) as full:
            ben.submit(MESH, PNG, CAMERA, mesh_format="obj")
    assert quota.value.retry_after_s
    assert full.value.retry_after_s


def test_the_status_of_a_full_queue(service: Service, folder: Path) -> None:
    files = {"mesh": ("m.obj", MESH), "silhouette": ("s.png", PNG)}
    fields = {"camera": '{"type": "look_at", "azimuth_degrees": 0, "elevation_degrees": 0, "distance": 2}'}
    answers = []
    for owner in ("ann", "ben"):
        with service.rest(make_key(folder, owner)) as rest:
            answers += [rest.post("/v1/refinements", files=files, data=fields) for _ in range(4)]
    assert [a.status_code for a in answers] == [202, 202, 202, 429, 202, 202, 503, 503]
    assert int(answers[3].headers["Retry-After"]) >= 1
    assert int(answers[6].headers["Retry-After"]) >= 1
    assert answers[6].json()["retryable"] is True


def call_often(client: RefineClient) -> None:
    for _ in range(1000):
        client.list()


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_calls_are_bounded(service: Service, folder: Path, transport: str) -> None:
    owner = f"hasty-{transport}"
    with service.client(transport, make_key(folder, owner)) as hasty:
        with pytest.raises(QuotaExceeded, match="at most 25 calls") as caught:
            call_often(hasty)
        assert caught.value.retry_after_s
    with service.client(transport, make_key(folder, f"calm-{transport}")) as calm:
        calm.list()


def test_the_bucket_fills_again() -> None:
    now = 0.0
    rate = CallRate(10, clock=lambda: now)
    for _ in range(20):  # two seconds' worth at once
        rate.take("ann")
    with pytest.raises(QuotaExceeded) as caught:
        rate.take("ann")
    assert caught.value.retry_after_s == pytest.approx(0.1)
    rate.take("ben")
    now = 0.1
    rate.take("ann")
    with pytest.raises(QuotaExceeded):
        rate.take("ann")


def test_the_file_holds_no_key(tmp_path: Path) -> None:
    key = make_key(tmp_path, "ann")
    [file] = tmp_path.glob("keys.json")
    assert key not in file.read_text()
    assert re.search(r"[0-9a-f]{64}", file.read_text())
    assert file.stat().st_mode & 0o077 == 0
    found = ApiKeys(file).find(key)
    assert found is not None
    assert found.owner == "ann"
    assert ApiKeys(file).find(key[:-1]) is None


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_a_key_sets_the_highest_priority(service: Service, folder: Path, transport: str) -> None:
    usual = make_key(folder, "ann")
    trusted = refine_keys(folder, "add", "eve", "--max-priority", "high").stdout.strip()
    with service.client(transport, trusted) as client:
        high = client.submit(MESH, PNG, CAMERA, mesh_format="obj", options={"priority": "high"})
        assert high.options.priority is Priority.HIGH
    with service.client(transport, usual) as client:
        client.submit(MESH, PNG, CAMERA, mesh_format="obj", options={"priority": "low"})
        with pytest.raises(OptionsInvalid, match="at most normal with this key, got high") as caught:
            client.submit(MESH, PNG, CAMERA, mesh_format="obj", options={"priority": "high"})
        assert caught.value.errors[0].pointer == "/options/priority"


def test_bad_owners_and_files(tmp_path: Path) -> None:
    assert refine_keys(tmp_path, "add", "a b").returncode == 2
    (tmp_path / "keys.json").write_text("{")
    bad = refine_keys(tmp_path, "list")
    assert bad.returncode == 2
    assert "keys.json" in bad.stderr
    assert "Traceback" not in bad.stderr


@pytest.mark.parametrize(
    ("host", "required"),
    [("127.0.0.1", False), ("::1", False), ("localhost", False), ("0.0.0.0", True), ("10.0.0.7", True)],
)
def test_when_a_key_is_required(host: str, required: bool) -> None:
    assert ServiceSettings(host=host).key_required is required
    assert ServiceSettings(host=host, require_key=True).key_required


def test_on_loopback_a_key_names_its_owner(redis_url: str, redis: Redis, tmp_path: Path) -> None:
    key = make_key(tmp_path, "ann")
    with run_service(redis_url, tmp_path) as service, service.rest() as rest:
        with service.client("rest", key) as client:
            client.submit(MESH, PNG, CAMERA, mesh_format="obj")
            assert len(client.list().refinements) == 1
        assert rest.get("/v1/refinements").json()["refinements"] == []  # anonymous
        assert rest.get("/v1/refinements", headers={"Authorization": "Bearer x"}).status_code == 401


def test_settings_that_cannot_be_read(tmp_path: Path) -> None:
    environment = {**os.environ, "REFINE_HTTP_PORT": "http", "REFINE_REDIS_URL": "redis://localhost"}
    command = [sys.executable, "-m", "refine_service", "--data-folder", str(tmp_path)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: REFINE_HTTP_PORT: ")
