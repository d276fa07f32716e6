"""`server_double.Script` over HTTP, on the standard library's server."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from server_double import Call, Script

from refine_proto.errors import RefineError


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    script: Script

    def do_GET(self) -> None:
        steps = [unquote(step) for step in urlsplit(self.path).path.split("/")[3:]]
        if not steps:
            query = {name: values[0] for name, values in parse_qs(urlsplit(self.path).query).items()}
            limit = int(query["limit"]) if "limit" in query else None
            self._answer("list", lambda: self.script.page(limit, query.get("cursor")))
        elif len(steps) == 1:
            self._answer("get", lambda: self.script.get(steps[0]))
        elif steps[1] == "events":
            self._guarded("watch", self._events, int(self.headers.get("Last-Event-ID", 0)))
        else:
            first = int(self.headers.get("Range", "bytes=0-")[len("bytes=") :].split("-")[0])
            self._guarded("download", lambda: self._artifact(steps[2], first), first)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        key = self.headers.get("Idempotency-Key", "")
        if self.path.endswith("/cancel"):
            self._answer("cancel", self._cancel)
        elif self.path == "/v1/refinements:validate":
            self._answer("validate", lambda: self.script.validation("", self._parts(body)))
        elif self.path == "/v1/cameras:estimate":
            self._answer("estimate", lambda: self.script.estimate("", self._parts(body)))
        else:
            self._answer("create", lambda: self.script.create(key, self._parts(body)), 202, key)

    def do_DELETE(self) -> None:
        def delete() -> None:
            self.script.delete(self.path.rsplit("/", 1)[1])
            self._send(204, b"")

        self._guarded("delete", delete)

    def _cancel(self) -> Any:
        self.script.cancelled.set()
        return self.script.refinement()

    def _answer(self, name: str, make: Callable[[], Any], status: int = 200, detail: Any = None) -> None:
        self._guarded(name, lambda: self._send(status, make().model_dump_json().encode()), detail)

    def _guarded(self, name: str, act: Callable[[], None], detail: Any = None) -> None:
        call = Call(name, self.headers["X-Request-Id"], self.headers.get("Authorization"), detail)
        try:
            self.script.enter(call)
            act()
        except RefineError as error:
            problem = error.problem(request_id=call.request_id).model_dump_json().encode()
            retry = {} if error.retry_after_s is None else {"Retry-After": f"{error.retry_after_s:g}"}
            self._send(error.status.http, problem, "application/problem+json", **retry)
        except OSError:  # the connection was dropped, as the script said
            self.close_connection = True

    def _send(self, status: int, body: bytes, media_type: str = "application/json", **headers: str) -> None:
        self.send_response(status)
        headers |= {"Content-Type": media_type, "Content-Length": str(len(body))}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _events(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream; charset=utf-8")
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(b": ping\r\n\r\n")
        if self.script.newer:
            self.wfile.write(b'event: resized\r\ndata: {"type": "resized", "state": "parked"}\r\n\r\n')
        for event in self.script.events(int(self.headers.get("Last-Event-ID", 0))):
            data = event.model_dump_json()
            self.wfile.write(f"id: {event.sequence}\r\nevent: {event.type}\r\ndata: {data}\r\n\r\n".encode())
            self.wfile.flush()

    def _artifact(self, name: str, offset: int) -> None:
        artifact = next(a for a in self.script.refinement().artifacts if a.name == name)
        size = artifact.size_bytes
        self.send_response(206 if offset else 200)
        if offset:
            self.send_header("Content-Range", f"bytes {offset}-{size - 1}/{size}")
        self.send_header("Content-Length", str(size - offset))
        self.send_header("ETag", f'"{artifact.sha256}"')
        self.end_headers()
        for portion in self.script.download(name, offset):
            self.wfile.write(portion)

    def _parts(self, body: bytes) -> dict[str, Any]:
        boundary = self.headers["Content-Type"].partition("boundary=")[2].encode()
        found: dict[str, Any] = {}
        for part in body.split(b"--" + boundary)[1:-1]:
            head, _, content = part.partition(b"\r\n\r\n")
            name = head.partition(b'name="')[2].partition(b'"')[0].decode()
            content = content[: -len(b"\r\n")]
            found[name] = content if b"filename=" in head else content.decode()
        return found | {
            name: json.loads(found[name])
            for name in ("camera", "options", "views", "webhook", "metadata")
            if name in found
        }

    def log_message(self, *arguments: Any) -> None:
        return None


class RestDouble:
    """Serves a script until closed."""

    def __init__(self, script: Script) -> None:
        handler = type("Handler", (_Handler,), {"script": script})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()
        self.port: int = self._server.server_address[1]

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
