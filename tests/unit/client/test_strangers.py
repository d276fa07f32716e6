"""Answers of something that is no REFINE server, or of a proxy before one, over real HTTP."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from server_double import ARTIFACTS, STEPS, Script

from refine_client import DownloadCorrupt, RefineClient, RetryPolicy
from refine_proto import errors
from refine_proto.models import State


class Stranger:
    """Answers every request with `answers`, one after the other; the last again and again."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, dict[str, str], bytes]] = []
        self.asked: list[dict[str, str]] = []
        stranger = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                stranger.asked.append(dict(self.headers))
                status, headers, body = stranger.answers[0]
                stranger.answers = stranger.answers[1:] or stranger.answers
                self.send_response(status)
                for name, value in ({"Content-Length": str(len(body))} | headers).items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *arguments: Any) -> None:
                return None

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)


@pytest.fixture
def stranger() -> Iterator[Stranger]:
    stranger = Stranger()
    thread = threading.Thread(target=stranger.server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield stranger
    stranger.server.shutdown()
    thread.join()
    stranger.server.server_close()


@pytest.fixture
def client(stranger: Stranger) -> Iterator[RefineClient]:
    address = f"http://127.0.0.1:{stranger.server.server_address[1]}"
    with RefineClient(address, retry=RetryPolicy(first_delay_s=0.01)) as client:
        yield client


HTML = {"Content-Type": "text/html"}


@pytest.mark.parametrize(
    ("status", "error", "tries"),
    [
        (301, errors.NotFound, 1),
        (400, errors.InvalidInput, 1),
        (401, errors.Unauthenticated, 1),
        (404, errors.NotFound, 1),
        (413, errors.PayloadTooLarge, 1),
        (429, errors.QuotaExceeded, 5),
        (500, errors.ServerError, 1),
        (502, errors.Unavailable, 5),
        (504, errors.Unavailable, 5),
    ],
)
def test_statuses_without_a_reason(
    client: RefineClient, stranger: Stranger, status: int, error: type[errors.RefineError], tries: int
) -> None:
    stranger.answers = [(status, HTML, b"<h1>nginx</h1>")]
    with pytest.raises(error, match=f"got {status} ") as caught:
        client.get("job-1")
    assert type(caught.value) is error
    assert len(stranger.asked) == tries
    assert caught.value.request_id == stranger.asked[-1]["X-Request-Id"]


def test_a_page_that_is_no_refinement(client: RefineClient, stranger: Stranger) -> None:
    stranger.answers = [(200, HTML | {"X-Request-Id": "theirs"}, b"<h1>Welcome</h1>")]
    with pytest.raises(errors.ServerError, match="is this a REFINE server") as caught:
        client.get("job-1")
    assert caught.value.request_id == "theirs"
    with pytest.raises(
        errors.ServerError, match=r"expected a stream of text/event-stream.*got 200 text/html"
    ):
        client.wait("job-1")


def test_retry_after_may_be_a_date(client: RefineClient, stranger: Stranger) -> None:
    later = format_datetime(datetime.now(UTC) + timedelta(hours=1), usegmt=True)
    stranger.answers = [(503, {"Retry-After": later}, b"")]
    with pytest.raises(errors.Unavailable) as caught:
        client.get("job-1")
    assert caught.value.retry_after_s is not None
    assert 3500 < caught.value.retry_after_s <= 3600
    assert len(stranger.asked) == 1


@pytest.mark.parametrize("value", ["soon", "nan", "inf", ""])
def test_a_retry_after_that_says_nothing(client: RefineClient, stranger: Stranger, value: str) -> None:
    stranger.answers = [(503, {"Retry-After": value}, b"")]
    with pytest.raises(errors.Unavailable) as caught:
        client.get("job-1")
    assert caught.value.retry_after_s is None


def events_answer(script: Script) -> tuple[int, dict[str, str], bytes]:
    events = [
        f"id: {event.sequence}\nevent: {event.type}\ndata: {event.model_dump_json()}\n\n".encode()
        for event in script.events(0)
    ]
    return 200, {"Content-Type": "text/event-stream; charset=utf-8"}, b"".join(events)


def test_what_is_sent_twice_is_given_once(client: RefineClient, stranger: Stranger, script: Script) -> None:
    script.watch_cuts = [("end", 4)]
    stranger.answers = [events_answer(script), events_answer(script)]  # the second ignores Last-Event-ID
    assert [event.sequence for event in client.watch("job-1")] == list(range(1, STEPS + 4))
    assert stranger.asked[1]["Last-Event-ID"] == "4"


def test_an_unreadable_event_is_not_asked_for_again(client: RefineClient, stranger: Stranger) -> None:
    stranger.answers = [(200, {"Content-Type": "text/event-stream"}, b"event: state\ndata: {]\n\n")]
    with pytest.raises(errors.ServerError, match="expected an Event") as caught:
        client.wait("job-1")
    assert len(stranger.asked) == 1
    assert caught.value.request_id == stranger.asked[0]["X-Request-Id"]


def artifact_answer(script: Script, **headers: str) -> tuple[int, dict[str, str], bytes]:
    artifact = script.refinement(State.SUCCEEDED).artifacts[0]
    return 200, {"ETag": f'"{artifact.sha256}"', **headers}, ARTIFACTS[artifact.name]


def test_a_server_without_ranges_is_understood(
    client: RefineClient, stranger: Stranger, script: Script, tmp_path: Path
) -> None:
    record = script.refinement(State.SUCCEEDED)
    (tmp_path / f".refined.glb.{record.artifacts[0].sha256[:16]}.part").write_bytes(
        ARTIFACTS["refined.glb"][:70_000]
    )
    stranger.answers = [(200, {}, record.model_dump_json().encode()), artifact_answer(script)]
    files = client.download("job-1", tmp_path, ["refined.glb"])
    assert files["refined.glb"].read_bytes() == ARTIFACTS["refined.glb"]
    assert stranger.asked[1]["Range"] == "bytes=70000-"
    assert stranger.asked[1]["If-Range"] == f'"{record.artifacts[0].sha256}"'


def test_another_etag_is_another_file(
    client: RefineClient, stranger: Stranger, script: Script, tmp_path: Path
) -> None:
    record = script.refinement(State.SUCCEEDED)
    stranger.answers = [
        (200, {}, record.model_dump_json().encode()),
        artifact_answer(script, ETag='"0000"'),
    ]
    with pytest.raises(DownloadCorrupt, match=r"with ETag .* got 0000") as caught:
        client.download("job-1", tmp_path, ["refined.glb"])
    assert caught.value.request_id == stranger.asked[-1]["X-Request-Id"]
    assert list(tmp_path.iterdir()) == []


def test_another_range_is_not_appended(
    client: RefineClient, stranger: Stranger, script: Script, tmp_path: Path
) -> None:
    record = script.refinement(State.SUCCEEDED)
    (tmp_path / f".refined.glb.{record.artifacts[0].sha256[:16]}.part").write_bytes(
        ARTIFACTS["refined.glb"][:7]
    )
    _, headers, body = artifact_answer(script)
    stranger.answers = [
        (200, {}, record.model_dump_json().encode()),
        (206, headers | {"Content-Range": f"bytes 9-{len(body) - 1}/{len(body)}"}, body[9:]),
    ]
    with pytest.raises(DownloadCorrupt, match="from byte 7 on"):
        client.download("job-1", tmp_path, ["refined.glb"])
