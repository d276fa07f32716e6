"""Strangers without a key on real sockets: what they may hold is bounded, and /livez answers beside them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from service_process import Service, run_service
from stranger import connect, is_closed, lives, send_until_closed
from worker_process import wait_until

MIB = 2**20
MAX_CONNECTIONS = 40
PER_ADDRESS = 20
SETTINGS = {
    "require_key": "true",
    "max_connections": MAX_CONNECTIONS,
    "max_connections_per_address": PER_ADDRESS,
    "head_timeout_s": 2,
    "write_timeout_s": 2,
}
HEAD = b"GET /livez HTTP/1.1\r\nHost: x\r\n"


@pytest.fixture(scope="module")
def service(redis_server: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with run_service(redis_server, tmp_path_factory.mktemp("service"), SETTINGS) as service:
        yield service


@pytest.fixture
def patient(redis_server: str, tmp_path: Path) -> Iterator[Service]:
    """A service that ends no connection for its silence while the test runs."""
    with run_service(redis_server, tmp_path, {**SETTINGS, "head_timeout_s": 600}) as service:
        yield service


@pytest.mark.parametrize(
    "begin",
    [
        HEAD,
        b"GET /" + b"a" * 100,
        b"POST /v1/refinements HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n",
    ],
    ids=["header", "target", "trailer"],
)
@pytest.mark.parametrize("piece", [b"X-Long: " + b"a" * 60_000 + b"\r\n", b"a" * 60_000], ids=["many", "one"])
def test_a_head_without_end_is_refused(service: Service, begin: bytes, piece: bytes) -> None:
    before = service.peak_memory_bytes()
    with connect(service) as connection:
        connection.sendall(begin)
        assert send_until_closed(connection, piece, 400 * MIB) < 20 * MIB
    assert service.peak_memory_bytes() - before < 20 * MIB
    assert lives(service)


def test_a_head_that_does_not_come_is_not_awaited(service: Service) -> None:
    with connect(service) as silent, connect(service) as half:
        half.sendall(HEAD)
        assert is_closed(silent)
        assert is_closed(half)


def test_a_second_head_has_no_longer(service: Service) -> None:
    with connect(service) as connection:
        connection.sendall(HEAD + b"\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
        connection.sendall(HEAD)
        assert is_closed(connection)


def test_idle_connections_make_room(patient: Service) -> None:
    with ExitStack() as stack:
        for number in range(3 * MAX_CONNECTIONS):
            stack.enter_context(connect(patient, f"127.0.0.{number % 8 + 2}"))
        assert lives(patient)
        assert patient.open_connections(patient.http_address[1]) <= MAX_CONNECTIONS


def test_one_address_has_its_share(patient: Service) -> None:
    with ExitStack() as stack:
        neighbour = stack.enter_context(connect(patient, "127.0.0.3"))
        greedy = [stack.enter_context(connect(patient, "127.0.0.2")) for _ in range(PER_ADDRESS + 5)]
        assert all(is_closed(connection) for connection in greedy[:5])
        neighbour.sendall(HEAD + b"\r\n")
        assert neighbour.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_more_connections_than_descriptors(redis_server: str, tmp_path: Path) -> None:
    """What stopped a service for good and filled its log: every descriptor an idle connection."""
    settings = {"require_key": "true", "max_connections_per_address": 10_000}
    with run_service(redis_server, tmp_path, settings, descriptors=256) as service, ExitStack() as stack:
        for _ in range(300):
            stack.enter_context(connect(service))
        assert lives(service)
        assert service.log_path.stat().st_size < 64 * 1024
        assert any("raise the limit of open files" in line["message"] for line in service.log())


def test_an_answer_that_nobody_reads_is_given_up(service: Service) -> None:
    with connect(service) as connection:
        request = b"GET /page/vendor/swagger-ui-bundle.js HTTP/1.1\r\nHost: x\r\n\r\n"
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for _ in range(8):
            connection.sendall(request)
        assert connection.recv(100).startswith(b"HTTP/1.1 200 ")
        wait_until(
            lambda: service.open_connections(service.http_address[1]) == 0,
            "the end of the connection that reads nothing",
        )


def test_requests_before_their_answers_are_bounded(service: Service) -> None:
    before = service.peak_memory_bytes()
    request = HEAD + b"\r\n"
    with connect(service) as connection:
        send_until_closed(connection, request * 5000, 20 * MIB)
    assert service.peak_memory_bytes() - before < 20 * MIB
    assert lives(service)
