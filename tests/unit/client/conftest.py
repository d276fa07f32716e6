"""A server that does what the test's script says, and the four ways to talk to it."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faces import AsyncFace, Face, SyncFace
from grpc_double import GrpcDouble
from rest_double import RestDouble
from server_double import DroppingProxy, Script

from refine_client import AsyncRefineClient, RefineClient, RetryPolicy

CAMERA = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.9}


@pytest.fixture
def script() -> Script:
    return Script()


@pytest.fixture
def rest_server(script: Script) -> Iterator[str]:
    double = RestDouble(script)
    proxy = DroppingProxy(double.port)
    script.drop = proxy.drop
    yield f"http://127.0.0.1:{proxy.port}"
    script.cancelled.set()
    proxy.close()
    double.close()


@pytest.fixture
def grpc_server(script: Script) -> Iterator[str]:
    double = GrpcDouble(script)
    proxy = DroppingProxy(double.port)
    script.drop = proxy.drop
    yield f"grpc://127.0.0.1:{proxy.port}"
    script.cancelled.set()
    double.close()
    proxy.close()


@pytest.fixture(params=["rest", "grpc"])
def server(request: pytest.FixtureRequest) -> str:
    """The server's address, once for each transport."""
    address: str = request.getfixturevalue(f"{request.param}_server")
    return address


@pytest.fixture(params=["sync", "async"])
def face(request: pytest.FixtureRequest, server: str) -> Iterator[Face]:
    policy = RetryPolicy(first_delay_s=0.01, longest_delay_s=0.05)
    if request.param == "sync":
        with RefineClient(server, api_key="key-1", retry=policy) as client:
            yield SyncFace(client)
        return
    with asyncio.Runner() as runner:
        async_client = AsyncRefineClient(server, api_key="key-1", retry=policy)
        yield AsyncFace(async_client, runner)
        runner.run(async_client.close())


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    path = tmp_path / "coarse.obj"
    path.write_bytes(b"v 0 0 0\n" * 20_000)
    return path


@pytest.fixture
def silhouette(tmp_path: Path) -> Path:
    path = tmp_path / "silhouette.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(1000))
    return path


@pytest.fixture
def camera() -> dict[str, Any]:
    return dict(CAMERA)
