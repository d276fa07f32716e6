"""Input files that a request names by their addresses, fetched chunk by chunk."""

from __future__ import annotations

import socket
from collections.abc import AsyncGenerator
from pathlib import PurePosixPath
from urllib.parse import unquote, urlsplit

import httpx

from refine_proto.errors import InvalidInput, from_validation
from refine_proto.formats import address_of

from .outgoing import AddressRefused, Outgoing

_STEP_S = 30.0  # for the connection, and between two chunks
_CHUNK_BYTES = 64 * 1024
_HEADERS = {"Accept-Encoding": "identity", "User-Agent": "refine"}


def file_name(url: str) -> str:
    """What the file is called at its address; its suffix may tell its format."""
    return PurePosixPath(unquote(urlsplit(url).path)).name


async def fetch(outgoing: Outgoing, part: str, url: str) -> AsyncGenerator[bytes, None]:
    """The bytes at an address; whoever reads them sees to it that they are not too many. InvalidInput."""
    try:
        async with outgoing.request("GET", url, _STEP_S, _HEADERS) as response:
            encoding = response.headers.get("Content-Encoding", "identity")
            if response.status_code != httpx.codes.OK or encoding != "identity":
                got = response.status_code if encoding == "identity" else f"Content-Encoding {encoding[:20]}"
                raise _wrong(part, f"expected the file at this address with status 200, got {got}")
            async for chunk in response.aiter_raw(_CHUNK_BYTES):
                yield chunk
    except AddressRefused as error:
        raise _wrong(part, str(error)) from None
    except (socket.gaierror, httpx.HTTPError, httpx.InvalidURL) as error:
        raise _wrong(part, f"expected the file at this address, got {type(error).__name__}") from None


def _wrong(part: str, message: str) -> InvalidInput:
    return from_validation([{"loc": (address_of(part),), "msg": message}])
