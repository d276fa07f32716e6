"""One `refine serve` for all tests here: real Redis, REST, gRPC, and one real slot on the CPU."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import httpx
import psutil
import pytest
from serve_process import Served, serve

from refine_client import RefineClient


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The server; at the end Ctrl-C stops it, and nobody is left."""
    with serve(tmp_path_factory.mktemp("served"), {"grpc_reflection": "true"}) as running:
        assert running.lines[-1].startswith("ready"), running.lines
        yield running
        family = running.family()
        assert len(family) >= 5, family  # Redis, service, worker, its slot, the slot's engine
        running.process.send_signal(signal.SIGINT)
        assert running.process.wait(90) == 0
        _, left = psutil.wait_procs(family, timeout=1)
        assert left == []


@pytest.fixture
def rest(served: Served) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{served.url}/v1", timeout=120) as client:
        yield client


@pytest.fixture
def client(served: Served) -> Iterator[RefineClient]:
    with RefineClient(served.url) as client:
        yield client
