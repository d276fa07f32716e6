"""Where the server is and who asks; when to try again."""

from __future__ import annotations

import subprocess
import sys

import pytest

from refine_client import AsyncRefineClient, RefineClient, RetryPolicy
from refine_client.address import DEFAULT_SERVER, Connection
from refine_client.retry import Retries
from refine_proto.errors import InvalidInput, QueueFull, RefineError, Unauthenticated, Unavailable


@pytest.mark.parametrize(
    ("server", "grpc", "tls"),
    [
        ("http://host:8000", False, False),
        ("https://host/prefix/", False, True),
        ("grpc://[::1]:50051", True, False),
        ("grpcs://host:443/", True, True),
    ],
)
def test_the_address_picks_the_transport(server: str, grpc: bool, tls: bool) -> None:
    connection = Connection.from_arguments(server, None, 30)
    assert (connection.grpc, connection.tls) == (grpc, tls)
    assert connection.server == server.rstrip("/")


@pytest.mark.parametrize(
    ("server", "says"),
    [
        ("host:8000", "did you mean http://host:8000"),
        ("ftp://host", "expected a server like http://"),
        ("http://", "expected a server like http://"),
        ("http://host:port", "expected a server like http://"),
        ("grpc://host", "expected grpc://host:port"),
        ("grpc://host:1/path", "expected grpc://host:port"),
        ("http://me:secret@host", "without user name"),
        ("http://host?key=secret", "without user name"),
    ],
)
def test_bad_addresses(server: str, says: str) -> None:
    with pytest.raises(InvalidInput, match=says) as caught:
        RefineClient(server)
    assert "secret" not in str(caught.value)


def test_the_environment_fills_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REFINE_SERVER", "http://other:1")
    monkeypatch.setenv("REFINE_API_KEY", "from-environment\n")
    assert Connection.from_arguments(None, None, 30).server == "http://other:1"
    assert Connection.from_arguments(None, None, 30).api_key == "from-environment"
    assert Connection.from_arguments(None, "given", 30).api_key == "given"
    monkeypatch.setenv("REFINE_SERVER", "")
    monkeypatch.setenv("REFINE_API_KEY", "")
    assert Connection.from_arguments(None, None, 30) == Connection(DEFAULT_SERVER)


def test_the_key_is_not_shown() -> None:
    connection = Connection("http://host", "very-secret")
    clients = [RefineClient("http://host", api_key="very-secret"), AsyncRefineClient("http://host")]
    assert "secret" not in repr(connection) + "".join(map(repr, clients))
    assert repr(clients[0]) == "RefineClient('http://host')"


def test_a_key_that_cannot_be_sent() -> None:
    with pytest.raises(Unauthenticated, match="printable ASCII") as caught:
        RefineClient("http://host", api_key="sëcret")
    assert "cret" not in str(caught.value)


def test_delays_double_with_jitter() -> None:
    retries = Retries(RetryPolicy(retries=5, first_delay_s=1, longest_delay_s=4))
    delays = [retries.delay_s(Unavailable("")) for _ in range(5)]
    for delay, longest in zip(delays, [1, 2, 4, 4, 4], strict=True):
        assert longest / 2 <= delay <= longest
    with pytest.raises(Unavailable, match="the last"):
        retries.delay_s(Unavailable("the last"))
    retries.reset()
    assert retries.delay_s(Unavailable("")) <= 1


def test_callers_do_not_come_back_together() -> None:
    policy = RetryPolicy()
    for retry_after_s in (None, 3.0):
        delays = {Retries(policy).delay_s(QueueFull("", retry_after_s=retry_after_s)) for _ in range(20)}
        assert len(delays) > 10
        assert min(delays) >= (retry_after_s or 0)


def test_importing_the_client_loads_nothing_heavy() -> None:
    program = (
        "import sys, refine_client; refine_client.RefineClient;"
        "heavy = {'torch', 'fastapi', 'numpy', 'redis', 'refine_engine', 'grpc', 'httpx', 'rich'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert answer.stdout == "[]\n"


@pytest.mark.parametrize(("scheme", "unused"), [("http", "grpc"), ("grpc", "httpx")])
def test_a_client_loads_only_its_transport(scheme: str, unused: str) -> None:
    program = (
        f"import sys, refine_client; refine_client.RefineClient('{scheme}://host:1').close();"
        f"print({unused!r} in sys.modules)"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert answer.stdout == "False\n"


@pytest.mark.parametrize("key", ["", "é", "line\nfeed", "x" * 256])
def test_bad_idempotency_keys(key: str) -> None:
    camera = {"type": "look_at", "azimuth_degrees": 0, "elevation_degrees": 0, "distance": 2}
    with RefineClient("http://127.0.0.1:1") as client, pytest.raises(RefineError, match="idempotency key"):
        client.submit(b"", b"", camera, idempotency_key=key)
