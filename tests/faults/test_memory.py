"""The bound on the service's memory that docs/security.md states, attacked in all its terms at once."""

from __future__ import annotations

import json
import socket
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import httpx
from service_process import CAMERA, MESH, PNG, Service, run_service
from stranger import connect, lives, send_until_closed

MIB = 2**20
CONNECTIONS, UPLOADS, WATCHERS, JSON_BYTES = 60, 8, 8, MIB
SETTINGS = {
    "max_connections": CONNECTIONS,
    "max_uploads": UPLOADS,
    "max_watchers": WATCHERS,
    "max_json_bytes": JSON_BYTES,
}
BOUND = (
    CONNECTIONS * MIB // 2 + UPLOADS * 13 * MIB // 2 + 16 * 8 * MIB + 12 * JSON_BYTES + WATCHERS * MIB // 5
)
LINE = b"X-Long: " + b"a" * 60_000 + b"\r\n"
PART = (
    b'--b\r\nContent-Disposition: form-data; name="%d"; filename="f"\r\n\r\n' + b"x" * (127 * 1024) + b"\r\n"
)
UPLOAD = (
    b"POST /v1/refinements HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000000\r\n"
    b"Content-Type: multipart/form-data; boundary=b\r\n\r\n"
)


def slow_upload(service: Service) -> socket.socket:
    """All that one upload can hold in memory, then silence."""
    connection = connect(service)
    connection.sendall(UPLOAD)
    for number in range(31):
        connection.sendall(PART % number)
    return connection


def test_the_bound_on_memory(redis_server: str, tmp_path: Path) -> None:
    body = json.dumps({"camera": CAMERA, "mesh": "A" * (JSON_BYTES - 1000), "silhouette": "AA=="}).encode()

    def post_json(service: Service) -> int:
        headers = {"Content-Type": "application/json"}
        return httpx.post(f"{service.rest_url}/v1/refinements", content=body, headers=headers).status_code

    with run_service(redis_server, tmp_path, SETTINGS) as service, ExitStack() as stack:
        assert lives(service)
        before = service.peak_memory_bytes()
        client = stack.enter_context(service.client("rest"))
        refinement = client.submit(MESH, PNG, CAMERA, mesh_format="obj")
        for _ in range(WATCHERS * 3 // 4):
            next(stack.enter_context(service.client("rest")).watch(refinement.id))
        for _ in range(UPLOADS // 2):
            stack.enter_context(slow_upload(service))
        with ThreadPoolExecutor(8) as pool:
            heads = [stack.enter_context(connect(service)) for _ in range(20)]
            endless = [pool.submit(send_until_closed, head, LINE, 25 * MIB) for head in heads]
            answers = list(pool.map(post_json, [service] * 20))
            assert all(sent.result() < 25 * MIB for sent in endless)
        assert set(answers) <= {415, 429, 503}
        assert lives(service)
        assert service.peak_memory_bytes() - before < BOUND
        client.cancel(refinement.id)
