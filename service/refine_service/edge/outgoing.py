"""Requests to addresses that callers name, which must not reach what only this machine can reach.

The host is resolved once, every address of it is judged, and the connection goes to exactly those that were
judged: a name that changes its address in between gains nothing. No redirect is followed, no proxy asked, no
connection used twice, and http is for the networks that the operator names.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import ssl
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TypeAlias

import httpx

Address: TypeAlias = ipaddress.IPv4Address | ipaddress.IPv6Address
Network: TypeAlias = ipaddress.IPv4Network | ipaddress.IPv6Network
Resolve: TypeAlias = Callable[[str, int], Awaitable[Sequence[str]]]

_UNICAST = ipaddress.IPv6Network("2000::/3")  # all that has been handed out
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")
_AZURE_METADATA = ipaddress.IPv4Address("168.63.129.16")  # public by its number; all others are not


class AddressRefused(ValueError):
    """The address may not be reached; the message says why, and nothing about the network."""


async def resolve(host: str, port: int) -> list[str]:
    """The addresses of a host; OSError if it has none."""
    try:
        found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except UnicodeError:  # a label that is too long
        raise socket.gaierror(f"expected the name of a host, got {host[:80]!r}") from None
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


def is_public(address: Address) -> bool:
    """Whether everybody can reach it, so that nothing is gained by asking us to."""
    if isinstance(address, ipaddress.IPv6Address):
        if address in _NAT64:
            return is_public(ipaddress.IPv4Address(int(address) & 0xFFFF_FFFF))
        if address.ipv4_mapped is not None:
            return is_public(address.ipv4_mapped)
        if address not in _UNICAST or address.sixtofour is not None or address.teredo is not None:
            return False
    return address.is_global and not address.is_multicast and address != _AZURE_METADATA


@dataclass(frozen=True)
class Outgoing:
    """Which addresses may be reached, and how. Belongs to the running event loop."""

    networks: Sequence[Network]  # private ones that may be reached all the same
    certificates: ssl.SSLContext
    resolve: Resolve = resolve

    @asynccontextmanager
    async def request(
        self,
        method: str,
        url: str,
        timeout_s: float,
        headers: Mapping[str, str] | None = None,
        content: bytes | None = None,
    ) -> AsyncGenerator[httpx.Response, None]:
        """The answer, of which the body is still to come. `timeout_s` is for each step, not for all of them.

        Raises AddressRefused, OSError (no such host), httpx.HTTPError.
        """
        target = httpx.URL(url)
        addresses = await self._judged(target)
        host = target.raw_host.decode()
        limits = httpx.Limits(max_keepalive_connections=0)
        async with httpx.AsyncClient(
            verify=self.certificates,
            trust_env=False,
            follow_redirects=False,
            timeout=timeout_s,
            limits=limits,
        ) as client:
            for number, address in enumerate(addresses, 1):
                request = client.build_request(
                    method,
                    target.copy_with(host=str(address), fragment=None),
                    headers={**(headers or {}), "Host": target.netloc.decode()},
                    content=content,
                    extensions={"sni_hostname": host},
                )
                try:
                    response = await client.send(request, stream=True)
                except (httpx.ConnectError, httpx.ConnectTimeout):
                    if number == len(addresses):
                        raise
                    continue
                try:
                    yield response
                finally:
                    await response.aclose()
                return

    async def _judged(self, url: httpx.URL) -> list[Address]:
        """All addresses of the host; AddressRefused if there is one that may not be reached."""
        port = url.port or (443 if url.scheme == "https" else 80)
        addresses = [
            ipaddress.ip_address(text.partition("%")[0]) for text in await self.resolve(url.host, port)
        ]
        for address in addresses:
            named = any(address in network for network in self.networks)
            if not (named or is_public(address)):
                raise AddressRefused(
                    f"expected a public address, got {url.host[:100]}, which has another; this server's "
                    "operator can allow its network (REFINE_REACHABLE_NETWORKS)"
                )
            if url.scheme != "https" and not named:
                raise AddressRefused(f"expected an https address, got {url.scheme}")
        return addresses
