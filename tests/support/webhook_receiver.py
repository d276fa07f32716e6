"""A real HTTP server that webhooks are sent to, what it got, and the short ways of tests about it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread
from typing import Any, TypeVar

from redis import Redis
from service_process import CAMERA, MESH, PNG

from refine_client import RefineClient
from refine_jobs import keys
from refine_proto.models import Refinement, WebhookDelivery

T = TypeVar("T")
_LONGEST_S = 30.0


@dataclass(frozen=True)
class Received:
    path: str
    headers: dict[str, str]
    body: bytes


@dataclass
class Receiver:
    """Answers with `statuses` one after the other, the last one from then on."""

    statuses: Sequence[int] = (204,)
    got: list[Received] = field(default_factory=list)
    headers: dict[str, str] = field(default_factory=dict)  # of the answers
    hold: Event | None = None  # answers only when it is set
    port: int = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook"

    def wait(self, count: int) -> list[Received]:
        """The first `count` requests."""
        deadline = time.monotonic() + _LONGEST_S
        while len(self.got) < count and time.monotonic() < deadline:
            time.sleep(0.02)
        assert len(self.got) >= count, self.got
        return self.got[:count]


@contextmanager
def receive(receiver: Receiver | None = None) -> Iterator[Receiver]:
    """A receiver on a free port, or on the one it had before."""
    found = receiver or Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            status = found.statuses[min(len(found.got), len(found.statuses) - 1)]
            found.got.append(Received(self.path, dict(self.headers), body))
            if found.hold is not None:
                found.hold.wait(_LONGEST_S)
            self.send_response(status)
            for name, value in found.headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def do_GET(self) -> None:
            raise AssertionError("a redirect was followed")

        def log_message(self, *_: Any) -> None:
            return None

    with ThreadingHTTPServer(("127.0.0.1", found.port), Handler) as server:
        found.port = server.server_port
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield found
        finally:
            if found.hold is not None:
                found.hold.set()
            server.shutdown()
            thread.join()


def submit(client: RefineClient, url: str, **more: Any) -> Refinement:
    return client.submit(MESH, PNG, CAMERA, mesh_format="obj", webhook={"url": url, **more})


def deliveries(client: RefineClient, refinement_id: str, count: int) -> list[WebhookDelivery]:
    """What the record says, as soon as it says so much."""
    return until(lambda: client.get(refinement_id).webhook_deliveries, lambda found: len(found) >= count)


def until(look: Callable[[], T], enough: Callable[[T], bool]) -> T:
    deadline = time.monotonic() + 30
    while not enough(found := look()) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert enough(found), found
    return found


def make_due(redis: Redis, refinement_id: str) -> None:
    """The next attempt is now."""
    assert redis.zadd(keys.OUTBOX, {refinement_id: 1}, xx=True, ch=True) == 1
