"""The gRPC server: our service, health checks and, behind a setting, reflection."""

from __future__ import annotations

import asyncio

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from refine_proto.v1.refine_pb2_grpc import add_RefinementsServicer_to_server

from ..edge.edge import Edge
from ..tls import Tls
from .admission import Admission
from .middleware import SERVICE, RpcCalls
from .refinements import Refinements

_MAX_CALLS = 4096  # at a time, in this process; more: RESOURCE_EXHAUSTED
_LOOK_S = 5.0  # between two looks whether the service is ready
_OPTIONS = (
    ("grpc.so_reuseport", 0),  # a second service on the port must fail, not share it
    ("grpc.max_receive_message_length", 4 * 2**20),  # files come in chunks
    ("grpc.max_concurrent_streams", 1000),  # of one connection
    ("grpc.max_metadata_size", 16 * 1024),
    ("grpc.absolute_max_metadata_size", 32 * 1024),
    ("grpc.server_handshake_timeout_ms", 10_000),  # of TLS, and of HTTP/2
    ("grpc.max_connection_idle_ms", 300_000),  # without a call; clients connect again by themselves
    ("grpc.keepalive_time_ms", 60_000),  # find out that the other side is gone
    ("grpc.http2.min_recv_ping_interval_without_data_ms", 10_000),  # callers may look after idle watches
)


class RpcServer:
    """A context in which the server runs."""

    def __init__(self, edge: Edge, max_connections: int, tls: Tls | None) -> None:
        self._edge, self._tls = edge, tls
        self._server = grpc.aio.server(
            interceptors=[Admission(edge), RpcCalls(edge)],
            options=(*_OPTIONS, ("grpc.max_allowed_incoming_connections", max_connections)),
            maximum_concurrent_rpcs=_MAX_CALLS,
        )
        self._health = health.aio.HealthServicer()
        add_RefinementsServicer_to_server(Refinements(edge), self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        if edge.settings.grpc_reflection:
            names = (SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME)
            reflection.enable_server_reflection(names, self._server)

    async def start(self) -> int:
        """Listen; the port. Raises OSError if it is taken."""
        settings = self._edge.settings
        address = f"{url_host(settings.host)}:{settings.grpc_port}"
        try:
            if self._tls is None:
                port = self._server.add_insecure_port(address)
            else:
                port = self._server.add_secure_port(address, self._tls.grpc_credentials())
        except RuntimeError as error:
            raise OSError(f"expected a free gRPC port, cannot listen on {address}") from error
        await self._server.start()
        return int(port)

    async def stop(self, grace_s: float) -> None:
        """Refuse new calls, let the others end."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace_s)

    async def show_health(self) -> None:
        """Tell readiness to those who watch grpc.health.v1, until cancelled."""
        while True:
            ready = await self._edge.not_ready() is None
            status = (
                health_pb2.HealthCheckResponse.SERVING
                if ready
                else health_pb2.HealthCheckResponse.NOT_SERVING
            )
            for name in ("", SERVICE):
                await self._health.set(name, status)
            await asyncio.sleep(_LOOK_S)


def url_host(host: str) -> str:
    """The host as it stands before a port."""
    return f"[{host}]" if ":" in host else host
