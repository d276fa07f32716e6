"""Where the server is, who asks and how long to wait for an answer."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from refine_proto.errors import InvalidInput, Unauthenticated

DEFAULT_SERVER = "http://127.0.0.1:8000"
SCHEMES = ("http", "https", "grpc", "grpcs")


@dataclass(frozen=True)
class Connection:
    """One server as one caller sees it. `repr` does not show the API key."""

    server: str
    """http://host[:port][/prefix], https://..., grpc://host:port or grpcs://host:port (gRPC over TLS)."""
    api_key: str | None = field(default=None, repr=False)
    """Sent as `Authorization: Bearer`."""
    timeout_s: float = 30.0
    """For an answer; a transfer may take longer while bytes flow."""

    def __post_init__(self) -> None:
        _check_server(self.server)
        if self.api_key is not None and not (self.api_key.isascii() and self.api_key.isprintable()):
            raise Unauthenticated("expected an API key of printable ASCII characters, got others")
        if not self.timeout_s > 0:
            raise InvalidInput(f"expected timeout_s above 0, got {self.timeout_s}")

    @classmethod
    def from_arguments(cls, server: str | None, api_key: str | None, timeout_s: float) -> Connection:
        """What is not given comes from REFINE_SERVER and REFINE_API_KEY; empty means not given."""
        server = server or os.environ.get("REFINE_SERVER") or DEFAULT_SERVER
        key = (api_key or os.environ.get("REFINE_API_KEY") or "").strip()
        return cls(server.rstrip("/"), key or None, timeout_s)

    @property
    def grpc(self) -> bool:
        """Whether the server is spoken to over gRPC; otherwise over REST."""
        return self.server.startswith("grpc")

    @property
    def tls(self) -> bool:
        return urlsplit(self.server).scheme in ("https", "grpcs")

    @property
    def target(self) -> str:
        """host:port"""
        return urlsplit(self.server).netloc


def _check_server(server: str) -> None:
    example = "http://host:8000, https://host, grpc://host:50051 or grpcs://host:443"
    try:
        url = urlsplit(server)
        port = url.port
    except ValueError as error:
        raise InvalidInput(f"expected a server like {example}, got {server!r}: {error}") from error
    if url.scheme not in SCHEMES or not url.hostname:
        hint = "" if "://" in server else f"; did you mean http://{server}?"
        raise InvalidInput(f"expected a server like {example}, got {server!r}{hint}")
    if url.username is not None or url.query or url.fragment:
        raise InvalidInput(
            "expected a server without user name, query or fragment; the API key goes into REFINE_API_KEY"
        )
    if url.scheme.startswith("grpc") and (port is None or url.path):
        raise InvalidInput(f"expected {url.scheme}://host:port, got {server!r}")
