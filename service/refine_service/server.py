"""One process, one event loop: REST and gRPC until SIGTERM or SIGINT, then a drain.

Drain: readiness turns false, event streams and watches end, nothing new is taken, calls that run may finish
within the grace period.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable
from functools import partial
from types import FrameType
from typing import cast

import uvicorn

from refine_jobs.settings import JobSettings

from .descriptors import connections_of_each_transport
from .edge.edge import Edge, open_edge
from .edge.webhooks import deliver_webhooks
from .rest.app import make_app
from .rest.connections import Gate, HttpConnection
from .rpc.server import RpcServer, url_host
from .settings import ServiceSettings
from .tls import Tls

_BACKLOG = 256
log = logging.getLogger(__name__)


async def run_service(
    settings: ServiceSettings, jobs: JobSettings, redis_url: str, listening: Callable[[str, str], None]
) -> None:
    """Serve until a signal; `listening` gets the REST URL and the gRPC address. OSError: a port is taken."""
    tls = Tls.from_settings(settings)
    connections = connections_of_each_transport(settings.max_connections)
    async with open_edge(settings, jobs, redis_url) as edge:
        rpc = RpcServer(edge, connections, tls)
        gate = Gate(settings, connections, tls)
        try:
            with _listen(settings) as listener:
                await _serve(edge, rpc, gate, listener, listening)
        finally:
            await rpc.stop(settings.grace_s)


async def _serve(
    edge: Edge, rpc: RpcServer, gate: Gate, listener: socket.socket, listening: Callable[[str, str], None]
) -> None:
    grpc_port = await rpc.start()
    http = _HttpServer(edge, gate)
    serving = asyncio.create_task(http.serve([listener]))
    health = asyncio.create_task(rpc.show_health())
    webhooks = asyncio.create_task(deliver_webhooks(edge))
    standing = asyncio.create_task(gate.watch())
    while not http.started and not serving.done():
        await asyncio.sleep(0.01)
    host = url_host(edge.settings.host)
    scheme = "http" if gate.tls is None else "https"
    listening(f"{scheme}://{host}:{listener.getsockname()[1]}", f"{host}:{grpc_port}")
    await asyncio.wait({serving, edge.draining}, return_when=asyncio.FIRST_COMPLETED)
    log.info("draining")
    health.cancel()
    await asyncio.gather(rpc.stop(edge.settings.grace_s), serving, webhooks)
    standing.cancel()
    log.info("stopped")


class _HttpServer(uvicorn.Server):
    """uvicorn, which on a signal first ends the streams that would keep it from stopping."""

    def __init__(self, edge: Edge, gate: Gate) -> None:
        super().__init__(
            uvicorn.Config(
                make_app(edge),
                http=cast(type[asyncio.Protocol], partial(HttpConnection, gate)),
                ws="none",
                # asyncio accepts so many before it lets us look at one of them: fewer than there is room for.
                backlog=max(8, gate.max_connections // 4),
                log_config=None,
                access_log=False,
                server_header=False,
                lifespan="off",
                timeout_graceful_shutdown=round(edge.settings.grace_s) or 1,
            )
        )
        self._draining = edge.draining
        self._loop = asyncio.get_running_loop()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """SIGTERM or SIGINT; a second SIGINT does not wait."""
        self._loop.call_soon_threadsafe(self._drain)
        self.force_exit = self.force_exit or (self.should_exit and sig == 2)
        self.should_exit = True

    def _drain(self) -> None:
        with contextlib.suppress(asyncio.InvalidStateError):
            self._draining.set_result(None)


def _listen(settings: ServiceSettings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # asyncio switches Nagle's algorithm off only for sockets that name their protocol; with it, every answer
    # would wait for a delayed acknowledgement, 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((settings.host, settings.http_port))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        address = f"{url_host(settings.host)}:{settings.http_port}"
        raise OSError(f"expected a free HTTP port, cannot listen on {address}: {error.strerror}") from error
    return listener
