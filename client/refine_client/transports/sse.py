"""Server-sent events (WHATWG HTML, section 9.2) out of bytes that arrive in any portions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

LONGEST_EVENT_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True)
class ServerSentEvent:
    """One dispatched event; comments, `retry` and empty events never become one."""

    id: str
    event: str
    data: str


class SseParser:
    """Feed it bytes, get events. Raises ValueError on an event beyond LONGEST_EVENT_BYTES."""

    def __init__(self) -> None:
        self._rest = b""
        self._after_cr = False
        self._id = ""
        self._event = ""
        self._data: list[bytes] = []
        self._size = 0

    def feed(self, portion: bytes) -> Iterator[ServerSentEvent]:
        """The events that `portion` completes."""
        if not portion:
            return
        if self._after_cr:
            portion = portion.removeprefix(b"\n")  # the second half of a CR LF
        self._after_cr = portion.endswith(b"\r")
        text = self._rest + portion
        *lines, self._rest = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
        for line in lines:
            self._check(len(line))
            if line:
                self._field(line)
            elif event := self._dispatch():
                yield event
        self._check(len(self._rest))

    def _field(self, line: bytes) -> None:
        name, _, value = line.partition(b":")
        value = value.removeprefix(b" ")
        if name == b"data":
            self._data.append(value)
            self._size += len(value)
        elif name == b"event":
            self._event = value.decode(errors="replace")
        elif name == b"id" and b"\0" not in value:
            self._id = value.decode(errors="replace")

    def _dispatch(self) -> ServerSentEvent | None:
        data, event = self._data, self._event
        self._data, self._event, self._size = [], "", 0
        if not data:
            return None
        return ServerSentEvent(self._id, event or "message", b"\n".join(data).decode(errors="replace"))

    def _check(self, more: int) -> None:
        if self._size + more > LONGEST_EVENT_BYTES:
            raise ValueError(f"expected an event of at most {LONGEST_EVENT_BYTES} bytes, got a longer one")
