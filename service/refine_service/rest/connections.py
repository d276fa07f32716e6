"""Connections over HTTP, bounded: how many, how large a head, and how long either side may stand still.

uvicorn's bounds are those of its h11 protocol or count calls of the application; a stranger needs to make no
call. Its httptools protocol, which we run on, is given them here, and TLS, so that a handshake counts too.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import socket
import time
from collections import Counter
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from ..settings import ServiceSettings
from ..tls import Tls

_LOOK_S = 1.0
_MAX_PIPELINED = 16
_TOO_LARGE = b"HTTP/1.1 431 Request Header Fields Too Large\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"

log = logging.getLogger(__name__)


class Gate:
    """All connections of this process.

    At a limit the connection that has waited longest for a request makes room. Only when all of them are in
    the middle of one is the new connection closed.
    """

    def __init__(self, settings: ServiceSettings, max_connections: int, tls: Tls | None) -> None:
        self.tls = tls
        self.max_header_bytes = settings.max_header_bytes
        self.head_timeout_s = settings.head_timeout_s
        self.write_timeout_s = settings.write_timeout_s
        self.max_connections = max_connections
        self._max_per_address = settings.max_connections_per_address
        self._connections: dict[HttpConnection, str] = {}  # with the address of each
        self._addresses: Counter[str] = Counter()

    def admit(self, connection: HttpConnection, address: str) -> bool:
        """Whether there is room for it, or room could be made."""
        if self._addresses[address] >= self._max_per_address and not self._end_longest_waiting(address):
            return False
        if len(self._connections) >= self.max_connections and not self._end_longest_waiting():
            return False
        self._connections[connection] = address
        self._addresses[address] += 1
        return True

    def release(self, connection: HttpConnection) -> None:
        """It has ended; safe to repeat."""
        address = self._connections.pop(connection, None)
        if address is not None:
            self._addresses[address] -= 1
            self._addresses += Counter()  # forget addresses without connections

    def _end_longest_waiting(self, address: str | None = None) -> bool:
        waiting = [
            connection
            for connection, from_address in self._connections.items()
            if connection.waiting_since is not None and address in (None, from_address)
        ]
        if not waiting:
            return False
        min(waiting, key=lambda connection: connection.waiting_since or 0.0).end()
        return True

    async def watch(self) -> None:
        """End connections that stand still, until cancelled."""
        while True:
            now = time.monotonic()
            for connection in list(self._connections):
                if connection.stands_still(now):
                    connection.end()
            await asyncio.sleep(_LOOK_S)


class HttpConnection(HttpToolsProtocol):
    """uvicorn's protocol behind a Gate."""

    def __init__(self, gate: Gate, **uvicorn: Any) -> None:
        super().__init__(**uvicorn)
        self._gate = gate
        self._raw: asyncio.Transport | None = None  # below TLS
        self._handshake: asyncio.Task[None] | None = None
        self._early = b""  # decrypted before the task of the handshake went on
        # Since when each lasts (time.monotonic), None while it does not:
        self.waiting_since: float | None = time.monotonic()  # for a whole head of a request
        self._unread_since: float | None = None  # the other side takes no bytes
        self._closing_since: float | None = None  # closed, and the last bytes are not taken
        self._head_bytes = 0  # received since the last piece of a body

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A connection was accepted."""
        self._raw = transport
        if not self._gate.admit(self, _address(transport)):
            transport.abort()
            return
        _look_for_dead_peers(transport)
        if self._gate.tls is None:
            super().connection_made(transport)
        else:
            transport.pause_reading()  # the first bytes are for the handshake
            self._handshake = self.loop.create_task(self._start_tls(transport, self._gate.tls))

    async def _start_tls(self, transport: asyncio.Transport, tls: Tls) -> None:
        try:
            encrypted = await self.loop.start_tls(
                transport,
                self,
                tls.context(),
                server_side=True,
                ssl_handshake_timeout=self._gate.head_timeout_s,
            )
        except (OSError, asyncio.CancelledError):  # no TLS, or too late
            encrypted = None
        if encrypted is None or encrypted.is_closing():
            self.end()
            return
        super().connection_made(encrypted)
        if self._early:
            self.data_received(self._early)

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended."""
        self._gate.release(self)
        if self.transport is not None:  # else it was never more than accepted
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes of heads and bodies."""
        if self.transport is None:
            self._early += data
            return
        self._head_bytes += len(data)
        super().data_received(data)
        if self._head_bytes > self._gate.max_header_bytes and not self.transport.is_closing():
            log.warning("a head of more than %d bytes was refused", self._gate.max_header_bytes)
            self.transport.write(_TOO_LARGE)
            self.transport.close()

    def on_headers_complete(self) -> None:
        """A whole head."""
        if len(self.pipeline) >= _MAX_PIPELINED:
            raise ValueError("more requests than answers")  # httptools makes it an error of the request
        self.waiting_since, self._head_bytes = None, 0
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """A piece of a body."""
        self._head_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """The end of a request."""
        self._head_bytes = 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """The end of an answer; the next request of a pipeline may begin."""
        if not self.pipeline:
            self.waiting_since = time.monotonic()
        super().on_response_complete()

    def pause_writing(self) -> None:
        """What waits to be sent is too much."""
        self._unread_since = time.monotonic()
        super().pause_writing()

    def resume_writing(self) -> None:
        """Most of it has been taken."""
        self._unread_since = None
        super().resume_writing()

    def stands_still(self, now: float) -> bool:
        """Whether one of the time-outs is over."""
        if self._closing_since is None and self.transport is not None and self.transport.is_closing():
            self._closing_since = now
        limits = (
            (self.waiting_since, self._gate.head_timeout_s),
            (self._unread_since, self._gate.write_timeout_s),
            (self._closing_since, self._gate.write_timeout_s),
        )
        return any(since is not None and now - since > longest_s for since, longest_s in limits)

    def end(self) -> None:
        """Close it at once; what has not been sent is lost."""
        self._gate.release(self)
        for transport in (self.transport, self._raw):
            if transport is not None:
                transport.abort()


def _address(transport: asyncio.Transport) -> str:
    """Whose limit a connection counts to: an IPv4 address, or the network of an IPv6 one, which has many."""
    name = transport.get_extra_info("peername")
    if not name:
        return ""  # gone already
    address = ipaddress.ip_address(str(name[0]).partition("%")[0])
    if isinstance(address, ipaddress.IPv4Address):
        return str(address)
    mapped = address.ipv4_mapped
    return str(mapped or ipaddress.ip_network((address, 64), strict=False))


def _look_for_dead_peers(transport: asyncio.Transport) -> None:
    with contextlib.suppress(OSError):
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
