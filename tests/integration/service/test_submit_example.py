"""examples/submit.sh prints the mesh and nothing else, however long it takes and whatever goes wrong."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[3] / "examples/submit.sh"
pytestmark = pytest.mark.skipif(shutil.which("curl") is None, reason="needs curl")


@contextmanager
def answering(answers: Sequence[tuple[int, bytes]]) -> Iterator[tuple[str, list[str]]]:
    """A server with these answers, one after the other: its address, and the idempotency keys that came."""
    keys: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            status, body = answers[len(keys)]
            keys.append(self.headers["Idempotency-Key"])
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            return None

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", keys
        server.shutdown()
        thread.join()


def run(server: str) -> subprocess.CompletedProcess[bytes]:
    environment = {**os.environ, "REFINE_SERVER": server}
    return subprocess.run([SCRIPT], env=environment, capture_output=True, check=False)


def test_it_waits_on_with_the_same_key() -> None:
    with answering([(406, b"{}"), (406, b"{}"), (200, b"glTF refined")]) as (server, keys):
        done = run(server)
    assert (done.returncode, done.stdout) == (0, b"glTF refined")
    assert len(keys) == 3
    assert len(set(keys)) == 1


@pytest.mark.parametrize("status", [202, 422, 503])
def test_what_is_no_mesh_is_an_error(status: int) -> None:
    with answering([(status, b'{"detail": "why"}')]) as (server, _):
        done = run(server)
    assert (done.returncode, done.stdout) == (1, b"")
    assert b"why" in done.stderr
