"""Which addresses are reached for callers, and that a connection goes to the one that was judged."""

from __future__ import annotations

import asyncio
import ipaddress
import ssl
import subprocess
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import httpx
import pytest

from refine_service.edge.outgoing import AddressRefused, Network, Outgoing, is_public
from refine_service.settings import ServiceSettings

LOOPBACK: Sequence[Network] = (ipaddress.ip_network("127.0.0.1"),)
NAME = "hooks.refine.test"


@pytest.mark.parametrize("address", ["1.1.1.1", "2606:4700::1111", "64:ff9b::101:101", "::ffff:1.1.1.1"])
def test_public_addresses(address: str) -> None:
    assert is_public(ipaddress.ip_address(address))


@pytest.mark.parametrize(
    "address",
    ["127.0.0.1", "0.0.0.0", "10.1.2.3", "172.16.0.1", "192.168.0.1", "169.254.169.254", "100.100.100.200",
     "168.63.129.16", "224.0.0.1", "255.255.255.255", "192.0.2.1", "198.18.0.1", "::", "::1", "fe80::1",
     "fd00:ec2::254", "ff02::1", "::ffff:127.0.0.1", "::ffff:10.0.0.1", "64:ff9b::7f00:1", "64:ff9b:1::1",
     "2002:7f00:1::", "2001:0:4136:e378:8000:63bf:3fff:fdd2"],
)  # fmt: skip
def test_all_others(address: str) -> None:
    assert not is_public(ipaddress.ip_address(address))


def names(**addresses: Sequence[str]) -> Any:
    """A resolver that knows one name."""

    async def resolve(host: str, port: int) -> Sequence[str]:
        return addresses[host.replace(".", "_")]

    return resolve


async def get(outgoing: Outgoing, url: str) -> tuple[int, bytes]:
    async with outgoing.request("GET", url, 5) as response:
        return response.status_code, await response.aread()


@pytest.mark.parametrize(
    "url",
    [
        "https://2130706433/",
        "https://0x7f.1/",
        "https://127.1/",
        "https://[::ffff:127.0.0.1]/",
        "https://localhost/",
    ],
)
def test_a_loopback_address_is_one_however_it_is_written(url: str) -> None:
    outgoing = Outgoing((), ssl.create_default_context())
    with pytest.raises(AddressRefused, match="public address"):
        asyncio.run(get(outgoing, url))


def test_one_private_address_among_public_ones_is_enough() -> None:
    resolve = names(mixed_test=["1.1.1.1", "10.0.0.1"])
    outgoing = Outgoing(LOOPBACK, ssl.create_default_context(), resolve)
    with pytest.raises(AddressRefused, match="public address"):
        asyncio.run(get(outgoing, "https://mixed.test/"))


def test_http_is_for_the_networks_that_the_operator_names() -> None:
    outgoing = Outgoing(LOOPBACK, ssl.create_default_context(), names(public_test=["1.1.1.1"]))
    with pytest.raises(AddressRefused, match="expected an https address"):
        asyncio.run(get(outgoing, "http://public.test/"))


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate of NAME and its key, in one file."""
    path = tmp_path_factory.mktemp("tls") / "both.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", f"/CN={NAME}",
         "-addext", f"subjectAltName=DNS:{NAME}", "-keyout", path, "-out", path.with_suffix(".crt")],
        check=True, capture_output=True,
    )  # fmt: skip
    path.write_text(path.read_text() + path.with_suffix(".crt").read_text())
    return path


@pytest.fixture
def https_port(certificate: Path) -> Iterator[int]:
    """A TLS server that answers with the Host that it was asked for."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = self.headers["Host"].encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(host)))
            self.end_headers()
            self.wfile.write(host)

        def log_message(self, *_: Any) -> None:
            return None

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def test_the_judged_address_is_reached_under_the_name(certificate: Path, https_port: int) -> None:
    """The name exists for our resolver only: whoever looked it up again would find nothing."""
    trusted = ssl.create_default_context(cafile=certificate.with_suffix(".crt"))
    addresses = ["127.0.0.2", "127.0.0.1"]  # nobody listens at the first
    networks = (ipaddress.ip_network("127.0.0.0/30"),)
    outgoing = Outgoing(networks, trusted, names(hooks_refine_test=addresses))
    url = f"https://{NAME}:{https_port}/"
    assert asyncio.run(get(outgoing, url)) == (200, f"{NAME}:{https_port}".encode())


def test_the_certificate_must_be_of_the_name(certificate: Path, https_port: int) -> None:
    trusted = ssl.create_default_context(cafile=certificate.with_suffix(".crt"))
    outgoing = Outgoing(LOOPBACK, trusted, names(other_test=["127.0.0.1"]))
    with pytest.raises(httpx.ConnectError, match="certificate"):
        asyncio.run(get(outgoing, f"https://other.test:{https_port}/"))


def test_networks_are_read_from_one_variable() -> None:
    settings = ServiceSettings.from_environment({"REFINE_REACHABLE_NETWORKS": "10.1.0.0/16, ::1"})
    assert [str(network) for network in settings.reachable_networks] == ["10.1.0.0/16", "::1/128"]
    with pytest.raises(ValueError, match="reachable_networks"):
        ServiceSettings.from_environment({"REFINE_REACHABLE_NETWORKS": "intranet"})
