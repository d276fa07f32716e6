"""Files that the service fetches from a real HTTP server: one that answers well, badly, endlessly, never."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import grpc
import httpx
import pytest
from redis import Redis
from service_process import CAMERA, MESH, PNG, Hand, Service, run_service

from refine_client import RefineClient, View
from refine_jobs import keys
from refine_proto.errors import InvalidInput, MeshInvalid, PayloadTooLarge, RefineError, UploadTimeout
from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub

LIMIT = 100_000
Answer = Callable[[BaseHTTPRequestHandler], None]


def content(data: bytes, status: int = 200, **headers: str) -> Answer:
    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(status)
        for name, value in headers.items():
            request.send_header(name.replace("_", "-"), value)
        request.send_header("Content-Length", str(len(data)))
        request.end_headers()
        request.wfile.write(data)

    return answer


def endless(pause_s: float) -> Answer:
    """Bytes without an announced length, until the other side has enough."""

    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(200)
        request.end_headers()
        with suppress(OSError):
            while True:
                request.wfile.write(b"v 0 0 0\n" * 500)
                time.sleep(pause_s)

    return answer


ANSWERS: dict[str, Answer] = {
    "/coarse.obj": content(MESH),
    "/silhouette.png": content(PNG),
    "/text.obj": content(b""),
    "/missing.obj": content(b"", 404),
    "/moved.obj": content(b"", 302, Location="/coarse.obj"),
    "/packed.obj": content(MESH, Content_Encoding="gzip"),
    "/endless.obj": endless(0.0),
    "/slow.obj": endless(0.2),
}


@pytest.fixture(scope="module")
def files() -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            ANSWERS[self.path.partition("?")[0]](self)

        def log_message(self, *_: Any) -> None:
            return None

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def shared_service(redis_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    settings = {"reachable_networks": "127.0.0.1", "max_mesh_bytes": LIMIT, "upload_timeout_s": 2}
    with run_service(redis_url, tmp_path_factory.mktemp("service"), settings) as service:
        yield service


def test_files_by_their_addresses(client: RefineClient, hand: Hand, files: str) -> None:
    views = [View(f"{files}/silhouette.png", CAMERA, PNG), View(PNG, CAMERA, f"{files}/silhouette.png")]
    refinement = client.submit(f"{files}/coarse.obj?signed=1", f"{files}/silhouette.png", CAMERA, views=views)
    job = hand.start(refinement.id)
    assert job.spec["mesh_format"] == "obj"
    for part in ("silhouette", "silhouette_2", "ignore_2", "silhouette_3", "ignore_3"):
        assert hand.blobs.get(keys.input_blob(job.id, part)) == PNG
    assert hand.blobs.get(keys.input_blob(job.id, keys.MESH)) == MESH


def test_the_same_content_is_the_same_submission(client: RefineClient, files: str) -> None:
    first = client.submit(f"{files}/coarse.obj", PNG, CAMERA, idempotency_key="k")
    second = client.submit(MESH, f"{files}/silhouette.png", CAMERA, mesh_format="obj", idempotency_key="k")
    assert first.id == second.id


def test_json_names_addresses_too(rest: httpx.Client, files: str) -> None:
    body = {
        "mesh_url": f"{files}/coarse.obj",
        "silhouette": base64.b64encode(PNG).decode(),
        "camera": CAMERA,
        "views": [{"camera": CAMERA, "silhouette_url": f"{files}/silhouette.png"}],
    }
    assert rest.post("/v1/refinements", json=body).status_code == 202
    answer = rest.post("/v1/refinements", json=body | {"silhouette_url": f"{files}/silhouette.png"})
    assert (answer.status_code, answer.json()["detail"]) == (
        422,
        "/silhouette: expected the file or its address, got both",
    )
    answer = rest.post("/v1/refinements", json={"camera": CAMERA, "silhouette_url": "file:///etc/passwd"})
    assert (answer.status_code, answer.json()["errors"][0]["pointer"]) == (422, "/silhouette_url")


@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("text.obj", MeshInvalid, "empty file"),
        (
            "missing.obj",
            InvalidInput,
            "/mesh_url: expected the file at this address with status 200, got 404",
        ),
        ("moved.obj", InvalidInput, "got 302"),
        ("packed.obj", InvalidInput, "got Content-Encoding gzip"),
        ("endless.obj", PayloadTooLarge, f"at most {LIMIT} bytes"),
        ("slow.obj", UploadTimeout, "within 2 s"),
    ],
)
def test_bad_answers(
    client: RefineClient, redis: Redis, files: str, name: str, error: type[RefineError], says: str
) -> None:
    with pytest.raises(error, match=says):
        client.submit(f"{files}/{name}", PNG, CAMERA)
    assert redis.zcard(keys.UPLOADS) == 0


def test_nobody_there(client: RefineClient) -> None:
    for url in (
        "http://127.0.0.1:1/a.obj",
        "https://no-such-host.invalid/a.obj",
        f"https://{'a' * 64}.test/a.obj",
    ):
        with pytest.raises(InvalidInput, match="/mesh_url: expected the file at this address"):
            client.submit(url, PNG, CAMERA)


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_private_addresses_are_not_reached(
    redis_url: str, tmp_path: Path, files: str, transport: str
) -> None:
    with run_service(redis_url, tmp_path) as service, service.client(transport) as client:
        for url in (f"{files}/coarse.obj", "http://169.254.169.254/latest/a.obj", "https://[::1]/a.obj"):
            with pytest.raises(InvalidInput, match="/mesh_url: expected a public address"):
                client.submit(url, PNG, CAMERA)


def test_only_files_of_the_request_have_addresses(service: Service, rest: httpx.Client) -> None:
    header = pb.CreateRefinementRequest.Header(file_urls={"report": "https://example.com"})
    header.spec.camera.look_at.distance = 2
    wrong = pytest.raises(grpc.RpcError, match="expected file_urls of mesh")
    with grpc.insecure_channel(service.grpc_address) as channel, wrong:
        RefinementsStub(channel).CreateRefinement(iter([pb.CreateRefinementRequest(header=header)]))
    answer = rest.post("/v1/refinements", data={"report_url": "https://example.com"}, files={"mesh": MESH})
    assert answer.status_code == 422
