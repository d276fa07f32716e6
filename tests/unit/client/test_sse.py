"""The stream format of WHATWG HTML, section 9.2, in any portions."""

from __future__ import annotations

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

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


def by_the_standard(stream: bytes) -> list[ServerSentEvent]:
    """Section 9.2.6 word for word, on a stream that is there as a whole."""
    events, data, event_type, last_id = [], "", "", ""
    *lines, _ = re.split("\r\n|\n|\r", stream.decode(errors="replace"))
    for line in lines:
        if line == "":
            if data != "":
                events.append(ServerSentEvent(last_id, event_type or "message", data.removesuffix("\n")))
            data = event_type = ""
        elif not line.startswith(":"):
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if name == "event":
                event_type = value
            elif name == "data":
                data += value + "\n"
            elif name == "id" and "\0" not in value:
                last_id = value
    return events


FIELDS = [
    b"data",
    b"data:",
    b"data: 1",
    b"data:  1",
    b"event: state",
    b"id: 7",
    b"id: \0",
    b"id",
    b": ping",
    b"",
]
LINES = st.sampled_from(FIELDS) | st.binary(max_size=6)
STREAMS = st.lists(st.tuples(LINES, st.sampled_from([b"\n", b"\r\n", b"\r"])).map(b"".join)).map(b"".join)


@given(STREAMS, st.lists(st.integers(0, 40)))
@example(b"data: 1\r\r", [])  # complete, though a line feed might still come
@example(b"data: 1\r\n\r\ndata: 2\n\n", [8, 0, 1, 1])
def test_any_stream_in_any_portions_is_what_the_standard_says(stream: bytes, sizes: list[int]) -> None:
    parser, start = SseParser(), 0
    events: list[ServerSentEvent] = []
    for size in [*sizes, len(stream)]:
        events += parser.feed(stream[start : start + size])
        start += size
    assert events == by_the_standard(stream)


@pytest.mark.parametrize("stream", [b"data: " + b"x" * 100, b"data: 12345678\n" * 20, b"x" * 100])
def test_an_endless_event_is_refused(stream: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sse, "LONGEST_EVENT_BYTES", 50)
    parser = SseParser()
    with pytest.raises(ValueError, match="at most 50 bytes"):
        _ = [list(parser.feed(bytes([byte]))) for byte in stream]


def test_an_event_of_exactly_the_most_bytes_passes_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sse, "LONGEST_EVENT_BYTES", 50)
    parser, event = (
        SseParser(),
        b"data:" + b"1" * 20 + b"\ndata:" + b"2" * 25 + b"\n\n",
    )  # the second line is 30 long
    assert len(list(parser.feed(3 * event))) == 3
    with pytest.raises(ValueError, match="at most 50 bytes"):
        list(parser.feed(event.replace(b"1", b"11", 1)))
