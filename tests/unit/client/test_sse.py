"""The stream format of WHATWG HTML, section 9.2, in any portions."""

from __future__ import annotations

import pytest

from refine_client.transports import sse
from refine_client.transports.sse import ServerSentEvent, SseParser

STREAM = (
    b": ping\n\n"
    b"id: 1\nevent: state\ndata: {}\n\n"
    b"data:first\ndata:  second\n\n"
    b"id: 2\r\nevent: progress\r\ndata: \xe2\x80\xa8 \xc3\xa4\r\nretry: 10\r\n\r\n"
    b"event: nothing\n\n"
    b"id: 3\rdata\r\r"
    b"data: unfinished\n"
)
EVENTS = [
    ServerSentEvent("1", "state", "{}"),
    ServerSentEvent("1", "message", "first\n second"),
    ServerSentEvent("2", "progress", "\u2028 ä"),
    ServerSentEvent("3", "message", ""),
]


@pytest.mark.parametrize("size", [1, 2, 3, 7, 1000])
def test_events_do_not_depend_on_the_portions(size: int) -> None:
    parser = SseParser()
    portions = [STREAM[i : i + size] for i in range(0, len(STREAM), size)]
    assert [event for portion in portions for event in parser.feed(portion)] == EVENTS


@pytest.mark.parametrize("stream", [b"data: " + b"x" * 100, b"data: 12345678\n" * 20, b"x" * 100])
def test_an_endless_event_is_refused(stream: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sse, "LONGEST_EVENT_BYTES", 50)
    parser = SseParser()
    with pytest.raises(ValueError, match="at most 50 bytes"):
        _ = [list(parser.feed(bytes([byte]))) for byte in stream]
