"""The worker's own port: its probes and its metrics over HTTP, for whoever watches this machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple

from prometheus_client import CONTENT_TYPE_LATEST

_TIMEOUT_S = 10.0  # of a connection that says nothing
PROBES = {"live": "/livez", "ready": "/readyz"}


class Answer(NamedTuple):
    """Whether it holds, and one line that says so."""

    holds: bool
    line: str


class Port:
    """Listens from the start on, one thread for each connection. Raises OSError where it cannot."""

    def __init__(
        self, host: str, port: int, probes: Mapping[str, Callable[[], Answer]], metrics: Callable[[], bytes]
    ) -> None:
        handler = type("Handler", (_Handler,), {"probes": probes, "metrics": staticmethod(metrics)})
        try:
            self._server = ThreadingHTTPServer((host, port), handler)
        except OSError as error:
            raise OSError(
                f"expected a free port, cannot listen on {host}:{port} (REFINE_WORKER_PORT): {error.strerror}"
            ) from error

    def serve(self) -> None:
        """Answer until the process ends."""
        self._server.serve_forever()


class _Handler(BaseHTTPRequestHandler):
    timeout = _TIMEOUT_S
    probes: Mapping[str, Callable[[], Answer]]
    metrics: Callable[[], bytes]

    def do_GET(self) -> None:
        """/livez, /readyz, /metrics."""
        if self.path == "/metrics":
            self._answer(200, CONTENT_TYPE_LATEST, self.metrics())
        elif self.path in self.probes:
            holds, line = self.probes[self.path]()
            self._answer(200 if holds else 503, "text/plain; charset=utf-8", f"{line}\n".encode())
        else:
            expected = ", ".join([*self.probes, "/metrics"])
            self._answer(404, "text/plain; charset=utf-8", f"expected one of {expected}\n".encode())

    def _answer(self, status: int, media_type: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Probes come every few seconds: no line for each."""
