"""A small server for what is hard to provoke in the real one: errors on demand, cut streams, wrong bytes.

`Script` is what happens, the same for `rest_double` and `grpc_double`; `DroppingProxy` stands before either.
"""

from __future__ import annotations

import hashlib
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from judgement import ESTIMATE

from refine_proto.checks import Code
from refine_proto.errors import Conflict, NotFound, RefineError
from refine_proto.models import (
    Artifact,
    CameraEstimate,
    Event,
    EventType,
    Finding,
    Progress,
    Refinement,
    RefinementOptions,
    RefinementPage,
    Severity,
    SilhouetteIou,
    State,
    Validation,
)

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
ARTIFACTS = {
    "refined.glb": bytes(range(256)) * 1024,
    "report.json": b'{"silhouette_iou": {"before": 0.5, "after": 0.9}}',
}
STEPS = 6  # progress events


@dataclass(frozen=True)
class Call:
    """One call as the server saw it."""

    name: str
    request_id: str
    authorization: str | None
    detail: Any = None  # idempotency key, after_sequence or offset


@dataclass
class Script:
    """What the server does, in the order of the calls; empty lists: everything works."""

    failures: list[RefineError | Callable[[], None]] = field(default_factory=list)
    """Each ends one call before it does anything: with an error, or with what the function does."""
    watch_cuts: list[tuple[Literal["drop", "end"], int]] = field(default_factory=list)
    """Each is for one watch: drop the connection, or end the stream properly, before event number n + 1."""
    drop_download_after: list[int] = field(default_factory=list)
    corrupt_downloads: int = 0
    ends_in: State = State.SUCCEEDED
    error: RefineError | None = None
    hang: bool = False
    """Whether the refinement runs until it is cancelled."""
    newer: bool = False
    """Whether every watch begins with an event of a type and a state that only a newer version knows."""

    checks: list[Finding] = field(default_factory=list)
    """What was found in the inputs of the refinement."""
    severity: Severity = Severity.WARNING
    """Of what a validation finds."""

    drop: Callable[[], None] = lambda: None
    """Set by the fixture: cuts all connections."""
    calls: list[Call] = field(default_factory=list)
    uploads: dict[str, dict[str, Any]] = field(default_factory=dict)  # by idempotency key
    cancelled: threading.Event = field(default_factory=threading.Event)
    deleted: bool = False

    def enter(self, call: Call) -> None:
        """Note the call; fail it if it is to fail."""
        self.calls.append(call)
        if self.failures:
            failure = self.failures.pop(0)
            if isinstance(failure, RefineError):
                raise failure
            failure()

    def seen(self, name: str) -> list[Call]:
        return [call for call in self.calls if call.name == name]

    def create(self, key: str, upload: dict[str, Any]) -> Refinement:
        self.uploads[key] = upload
        return self.refinement(State.QUEUED, upload.get("options", {}))

    def validation(self, key: str, upload: dict[str, Any]) -> Validation:
        self.uploads[key] = upload
        finding = Finding(code=Code.LOW_OVERLAP, severity=self.severity, message="expected more")
        return Validation.of(0.3, ["2 of 9 triangles", "expected more"], [finding])

    def estimate(self, key: str, upload: dict[str, Any]) -> CameraEstimate:
        self.uploads[key] = upload
        return ESTIMATE

    def refinement(self, state: State | None = None, options: Any = None) -> Refinement:
        state = state or (State.CANCELLED if self.cancelled.is_set() else self.ends_in)
        done = state is State.SUCCEEDED
        artifacts = [
            Artifact(
                name=name,
                media_type="application/octet-stream",
                size_bytes=len(data),
                sha256=hashlib.sha256(data).hexdigest(),
            )
            for name, data in ARTIFACTS.items()
        ]
        return Refinement(
            id="job-1",
            state=state,
            options=RefinementOptions.model_validate(options or {}),
            created_at=NOW,
            expires_at=NOW,
            artifacts=artifacts if done else [],
            silhouette_iou=SilhouetteIou(before=0.5, after=0.9) if done else None,
            checks=self.checks if done else [],
            warnings=[finding.message for finding in self.checks] if done else [],
            error=self.error.problem(request_id="req-job") if self.error and state.terminal else None,
            queue_position=3 if state is State.QUEUED else None,
        )

    def get(self, refinement_id: str) -> Refinement:
        if refinement_id != "job-1" or self.deleted:
            raise NotFound(f"expected the id of a refinement of yours, got {refinement_id!r}")
        return self.refinement()

    def page(self, limit: int | None, cursor: str | None) -> RefinementPage:
        return RefinementPage(
            refinements=[self.refinement()] * min(2, limit or 2), next_cursor=None if cursor else "page-2"
        )

    def delete(self, refinement_id: str) -> None:
        self.get(refinement_id)
        if self.hang and not self.cancelled.is_set():
            raise Conflict("expected a refinement that has ended; cancel it first")
        self.deleted = True

    def events(self, after_sequence: int) -> Iterator[Event]:
        """The events after a sequence, as far as the script lets them."""
        how, last = self.watch_cuts.pop(0) if self.watch_cuts else ("end", 3 + STEPS)
        for event in self._history():
            if event.sequence > last:
                if how == "drop":
                    self.drop()
                return
            if event.sequence > after_sequence:
                yield event

    def _history(self) -> Iterator[Event]:
        yield Event(sequence=1, type=EventType.STATE, time=NOW, state=State.QUEUED)
        yield Event(sequence=2, type=EventType.STATE, time=NOW, state=State.RUNNING)
        for step in range(STEPS):
            progress = Progress(
                iteration=step + 1,
                total=STEPS,
                percent=100 * (step + 1) / STEPS,
                eta_s=0.5,
                losses={"total": 1.5},
                silhouette_iou=0.75,
            )
            yield Event(
                sequence=3 + step, type=EventType.PROGRESS, time=NOW, state=State.RUNNING, progress=progress
            )
        if self.hang and not self.cancelled.wait(20):
            return
        final = self.refinement()
        yield Event(
            sequence=3 + STEPS, type=EventType.COMPLETED, time=NOW, state=final.state, refinement=final
        )

    def download(self, name: str, offset: int) -> Iterator[bytes]:
        """The bytes from an offset on, perhaps wrong, perhaps cut off."""
        data = ARTIFACTS[name]
        if self.corrupt_downloads:
            self.corrupt_downloads -= 1
            data = data[:-1] + bytes([data[-1] ^ 1])
        cut = self.drop_download_after.pop(0) if self.drop_download_after else len(data)
        for start in range(offset, min(cut, len(data)), 16 * 1024):
            yield data[start : min(start + 16 * 1024, cut)]
        if cut < len(data):
            self.drop()


class DroppingProxy:
    """A TCP proxy whose connections can be reset all at once."""

    def __init__(self, upstream_port: int) -> None:
        self._upstream_port = upstream_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self.port: int = self._listener.getsockname()[1]
        self._start(self._accept)

    def drop(self) -> None:
        """Reset every connection, in both directions."""
        with self._lock:
            sockets, self._open = self._open, set()
        for one in sockets:
            with suppress(OSError):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def close(self) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop()
        for thread in self._threads:
            thread.join()

    def _start(self, target: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(("127.0.0.1", self._upstream_port))
            with self._lock:
                self._open |= {near, far}
            self._start(self._forward, near, far)
            self._start(self._forward, far, near)

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while portion := source.recv(65536):
                target.sendall(portion)
        with suppress(OSError):
            target.shutdown(socket.SHUT_WR)
        with self._lock:
            self._open.discard(source)
        source.close()
