"""Health, metrics, logs, and a Redis that goes away."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from prometheus_client.parser import text_string_to_metric_families
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.slots import SlotState
from refine_proto.errors import MeshInvalid, Unavailable

SERVICE = "refine.v1.Refinements"
SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def health_of(service: Service, name: str) -> int:
    with grpc.insecure_channel(service.grpc_address) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        return int(stub.Check(health_pb2.HealthCheckRequest(service=name)).status)


def test_readiness_does_not_hang_on_workers(service: Service, rest: httpx.Client, hand: Hand) -> None:
    idle = dict.fromkeys(SlotState, 0)
    assert rest.get("/readyz").json() == {"status": "ready", "slots": idle}
    assert health_of(service, SERVICE) == health_of(service, "") == SERVING
    hand.show_slot()
    assert rest.get("/readyz").json()["slots"] == idle | {"idle": 1}
    assert rest.get("/livez").json() == {"status": "live"}


def test_who_asks_for_slots_hears_of_those_that_can_work(rest: httpx.Client, hand: Hand) -> None:
    def ready(slots: int) -> bool:
        answer = rest.get("/readyz", params={"slots": slots})
        assert answer.status_code == 200 or (answer.json()["reason"], answer.headers["Retry-After"]) == (
            "UNAVAILABLE",
            "10",
        )
        return answer.status_code == 200

    for state in (SlotState.STARTING, SlotState.DRAINING):
        hand.show_slot(state)
        assert (ready(0), ready(1)) == (True, False)
    for state in (SlotState.IDLE, SlotState.BUSY):
        hand.show_slot(state)
        assert (ready(1), ready(2)) == (True, False)
    assert rest.get("/readyz", params={"slots": -1}).status_code == 422


def test_readiness_needs_a_blob_store(redis_url: str, tmp_path: Path) -> None:
    with run_service(redis_url, tmp_path) as service, service.rest() as rest:
        assert rest.get("/readyz").status_code == 200
        shutil.rmtree(tmp_path / "blobs")
        (tmp_path / "blobs").write_text("in the way")
        answer = rest.get("/readyz")
        assert answer.status_code == 503
        assert answer.json()["detail"] == "the blob store takes no writes; the service's log says why"
        [line] = [line for line in service.log() if "takes no writes" in line["message"]]
        assert "blobs" in line["message"]  # the path, which is none of a stranger's business
        until(lambda: health_of(service, SERVICE) == NOT_SERVING)
        with service.client("rest") as client, pytest.raises(Unavailable, match="blob store"):
            client.submit(MESH, PNG, CAMERA, mesh_format="obj")


def test_reflection_tells_the_services(service: Service) -> None:
    with grpc.insecure_channel(service.grpc_address) as channel:
        stub = reflection_pb2_grpc.ServerReflectionStub(channel)
        request = reflection_pb2.ServerReflectionRequest(list_services="")
        [answer] = stub.ServerReflectionInfo(iter([request]))
    names = {service.name for service in answer.list_services_response.service}
    assert names == {SERVICE, "grpc.health.v1.Health", "grpc.reflection.v1alpha.ServerReflection"}


def test_reflection_is_off_unless_asked_for(redis_url: str, tmp_path: Path) -> None:
    with run_service(redis_url, tmp_path) as service, grpc.insecure_channel(service.grpc_address) as channel:
        stub = reflection_pb2_grpc.ServerReflectionStub(channel)
        with pytest.raises(grpc.RpcError) as caught:
            list(stub.ServerReflectionInfo(iter([reflection_pb2.ServerReflectionRequest(list_services="")])))
    assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED


def exposed(rest: httpx.Client, path: str) -> dict[tuple[str, ...], float]:
    """Values by name and sorted values of the labels."""
    return {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(rest.get(path).text)
        for sample in family.samples
    }


def test_metrics(service: Service, rest: httpx.Client, hand: Hand) -> None:
    hand.show_slot()
    with service.client("grpc") as client:
        sent = [client.submit(MESH, PNG, CAMERA, mesh_format="obj").id for _ in range(4)]
    hand.run(sent[0], {})
    hand.store.fail(hand.start(sent[1]), MeshInvalid("expected triangles, got none"))
    hand.start(sent[2])
    values = exposed(rest, "/metrics") | exposed(rest, "/metrics/installation")
    assert values["refine_submitted_jobs_total",] == 4
    assert values["refine_queued_jobs",] == 1
    assert values["refine_running_jobs",] == 1
    assert values["refine_queue_seconds_count",] == 3
    assert values["refine_queue_seconds_bucket", "+Inf"] == 3
    assert values["refine_run_seconds_count",] == 2
    assert values["refine_jobs_total", "", "succeeded"] == 1
    assert values["refine_jobs_total", "MESH_INVALID", "failed"] == 1
    assert values["refine_jobs_total", "WORKER_LOST", "failed"] == 0
    assert values["refine_requeued_jobs_total", "lost"] == 0
    assert 0 < values["refine_oldest_queued_job_age_seconds",] < 60
    assert [values["refine_slots", state] for state in SlotState] == [0, 1, 0, 0]
    assert values["refine_redis_persistence_ok",] == 1
    assert 0 < values["refine_blob_store_free_bytes",] < values["refine_blob_store_size_bytes",]
    [build] = [name for name in values if name[0] == "refine_build_info"]
    assert version("refine-mesh") in build
    assert values["refine_received_bytes_total", "grpc"] > 4 * (len(MESH) + len(PNG))
    assert values["refine_call_seconds_count", "CreateRefinement", "OK", "grpc"] >= 4


def test_gauges_stay_where_there_is_no_worker_and_no_job(rest: httpx.Client) -> None:
    values = exposed(rest, "/metrics/installation")
    for name in ("refine_queued_jobs", "refine_running_jobs", "refine_oldest_queued_job_age_seconds"):
        assert values[name,] == 0
    assert [values["refine_slots", state] for state in SlotState] == [0] * len(SlotState)


def test_the_metrics_of_a_process_tell_nothing_of_the_installation(rest: httpx.Client) -> None:
    """So that a sum over processes counts no job twice."""
    process = {name for name, *_ in exposed(rest, "/metrics")}
    installation = {name for name, *_ in exposed(rest, "/metrics/installation")}
    assert not process & installation
    assert not [name for name in process if "jobs" in name or "slots" in name]


@pytest.mark.skipif(not shutil.which("promtool"), reason="promtool is not installed (Debian: prometheus)")
@pytest.mark.parametrize("path", ["/metrics", "/metrics/installation"])
def test_promtool_has_nothing_to_say(rest: httpx.Client, path: str) -> None:
    command = ["promtool", "check", "metrics"]
    told = subprocess.run(command, input=rest.get(path).text, capture_output=True, text=True, check=False)
    assert (told.returncode, told.stdout + told.stderr) == (0, "")


def test_log_lines_carry_the_ids(service: Service, rest: httpx.Client) -> None:
    trace = "0af7651916cd43dd8448eb211c80319c"
    with service.client("rest") as client:
        refinement_id = client.submit(MESH, PNG, CAMERA, mesh_format="obj").id
    headers = {"X-Request-Id": "log-me", "traceparent": f"00-{trace}-b7ad6b7169203331-01"}
    rest.get(f"/v1/refinements/{refinement_id}", headers=headers)
    [line] = [line for line in service.log() if line.get("request_id") == "log-me"]
    assert (line["job_id"], line["trace_id"], line["status"]) == (refinement_id, trace, "200")
    assert line["method"] == "GET /v1/refinements/{refinement_id}"


@pytest.mark.parametrize("sent", ["", "bad id", "x" * 200, "00-0-0-0"])
def test_ids_that_are_none_are_replaced(rest: httpx.Client, sent: str) -> None:
    answer = rest.get("/livez", headers={"X-Request-Id": sent, "traceparent": sent})
    assert len(answer.headers["X-Request-Id"]) in (8, 32)
    assert "traceparent" not in answer.headers


def test_redis_goes_and_comes_back(tmp_path: Path) -> None:
    redis_folder = tmp_path / "redis"
    with EmbeddedRedis(redis_folder) as server:
        url = server.url
        with run_service(url, tmp_path / "data") as service, service.rest() as rest:
            with service.client("rest") as client:
                refinement_id = client.submit(MESH, PNG, CAMERA, mesh_format="obj").id
            server.stop()
            for path in (
                "/v1/refinements",
                f"/v1/refinements/{refinement_id}",
                "/readyz",
                "/metrics/installation",
            ):
                answer = rest.get(path)
                assert (answer.status_code, answer.json()["reason"]) == (503, "UNAVAILABLE")
                assert answer.headers["Retry-After"]
            with service.client("grpc") as client, pytest.raises(Unavailable):
                client.submit(MESH, PNG, CAMERA, mesh_format="obj")
            assert rest.get("/livez").status_code == rest.get("/metrics").status_code == 200
            assert service.stop() == 0


def test_a_service_that_starts_before_its_redis(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with run_service(f"redis://127.0.0.1:{port}", tmp_path) as service, service.rest() as rest:
        assert rest.get("/livez").status_code == 200
        assert rest.get("/v1/refinements").status_code == 503


def test_a_taken_port_is_told(service: Service, redis_url: str, tmp_path: Path) -> None:
    for setting, url in (("HTTP", service.rest_url), ("GRPC", service.grpc_address)):
        ports = {"REFINE_HTTP_PORT": "0", "REFINE_GRPC_PORT": "0"}
        ports[f"REFINE_{setting}_PORT"] = url.rpartition(":")[2]
        ended = subprocess.run(
            [sys.executable, "-m", "refine_service", "--data-folder", str(tmp_path)],
            env={**os.environ, "REFINE_REDIS_URL": redis_url, **ports},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ended.returncode == 2
        assert "cannot listen on" in ended.stderr.splitlines()[-1]


def test_the_service_is_light() -> None:
    """No numerics, and nothing of the worker."""
    program = "import sys, refine_service.server, refine_service.commands.serve; print(*sys.modules)"
    command = [sys.executable, "-c", program]
    loaded = set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert not loaded & {"torch", "numpy", "trimesh", "numba", "scipy", "refine_engine", "refine_worker"}


def test_sigint_drains_too(redis_url: str, tmp_path: Path) -> None:
    with run_service(redis_url, tmp_path) as service:
        service.process.send_signal(signal.SIGINT)
        assert service.process.wait(30) == 0
    messages = [line["message"] for line in service.log()]
    assert messages.index("draining") < messages.index("stopped")
