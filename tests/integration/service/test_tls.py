"""TLS of both transports from one certificate: handshakes, the SDK, and a new certificate while it runs."""

from __future__ import annotations

import os
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import grpc
import httpx
import pytest
from certificates import Authority
from cryptography import x509
from service_process import Service, run_service

from refine_proto.v1 import refine_pb2 as pb
from refine_proto.v1.refine_pb2_grpc import RefinementsStub


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tls")


@pytest.fixture(scope="module")
def authority(folder: Path) -> Authority:
    return Authority(folder)


@pytest.fixture(scope="module")
def shared_service(redis_url: str, folder: Path, authority: Authority) -> Iterator[Service]:
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    authority.issue(certificate, key)
    settings = {"tls_certificate": certificate, "tls_key": key, "head_timeout_s": 2}
    with run_service(redis_url, folder / "data", settings) as service:
        yield service


def shown_serials(service: Service, authority: Authority) -> set[int]:
    """Of the certificates that the two transports show to a client that trusts the authority."""
    serials = set()
    grpc_host, _, grpc_port = service.grpc_address.rpartition(":")
    for address in (service.http_address, (grpc_host, int(grpc_port))):
        context = ssl.create_default_context(cafile=str(authority.root))
        context.set_alpn_protocols(["h2", "http/1.1"])
        with (
            socket.create_connection(address, timeout=20) as plain,
            context.wrap_socket(plain, server_hostname="localhost") as encrypted,
        ):
            assert encrypted.version() in ("TLSv1.2", "TLSv1.3")
            shown = encrypted.getpeercert(binary_form=True)
            assert shown is not None
            serials.add(x509.load_der_x509_certificate(shown).serial_number)
    return serials


def test_rest(service: Service, authority: Authority) -> None:
    assert service.rest_url.startswith("https://")
    trusting = ssl.create_default_context(cafile=str(authority.root))
    for _ in range(10):  # a request may come together with the end of the handshake, or after it
        answer = httpx.get(f"{service.rest_url}/livez", verify=trusting)
        assert (answer.status_code, answer.headers["Strict-Transport-Security"]) == (200, "max-age=31536000")
    with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
        httpx.get(f"{service.rest_url}/livez")


def test_grpc(service: Service, authority: Authority) -> None:
    credentials = grpc.ssl_channel_credentials(authority.root.read_bytes())
    with grpc.secure_channel(service.grpc_address, credentials) as channel:
        page = RefinementsStub(channel).ListRefinements(pb.ListRefinementsRequest(), timeout=20)
    assert page.refinements == []


@pytest.mark.parametrize("transport", ["rest", "grpc"])
def test_the_sdk(service: Service, authority: Authority, transport: str) -> None:
    """With the variables that name the trusted root."""
    server = service.rest_url if transport == "rest" else f"grpcs://{service.grpc_address}"
    program = "import refine_client; print(len(refine_client.RefineClient().list().refinements))"
    roots = ("SSL_CERT_FILE", "GRPC_DEFAULT_SSL_ROOTS_FILE_PATH")
    environment = {**os.environ, "REFINE_SERVER": server} | dict.fromkeys(roots, str(authority.root))
    ended = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert (ended.stdout, ended.returncode) == ("0\n", 0), ended.stderr


def test_plain_and_silent_connections_end(service: Service) -> None:
    with socket.create_connection(service.http_address, timeout=20) as plain:
        plain.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n")
        assert b"HTTP/1.1 200" not in plain.recv(65536)
    with socket.create_connection(service.http_address, timeout=20) as silent:
        assert silent.recv(1) == b""


def test_a_new_certificate_while_it_runs(service: Service, authority: Authority, folder: Path) -> None:
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    serial = authority.issue(certificate, key)
    assert shown_serials(service, authority) == {serial}
    certificate.write_text("damaged")
    assert shown_serials(service, authority) == {serial}
    assert any("certificate in use stays" in line["message"] for line in service.log())


@pytest.mark.parametrize("given", [["tls_key"], ["tls_key", "tls_certificate"]])
def test_files_that_cannot_be_used(folder: Path, given: list[str]) -> None:
    (folder / "bad.pem").write_text("no certificate")
    environment = {**os.environ, "REFINE_REDIS_URL": "redis://127.0.0.1:1"}
    environment |= {f"REFINE_{name.upper()}": str(folder / "bad.pem") for name in given}
    command = [sys.executable, "-m", "refine_service", "--data-folder", str(folder / "none")]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "REFINE_TLS_CERTIFICATE" in ended.stderr or "bad.pem" in ended.stderr
    assert "Traceback" not in ended.stderr
