"""A queue, a blob folder and workers of their own for each fault."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from worker_process import StartWorker, Worker, Workplace, run_worker

from refine_jobs.embedded import EmbeddedRedis


@pytest.fixture(scope="session")
def redis_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Its URL."""
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server.url


@pytest.fixture
def workplace(redis_server: str, tmp_path: Path) -> Iterator[Workplace]:
    """That no other test uses."""
    place = Workplace(redis_server, tmp_path / "data", pool=tmp_path.name.replace("_", "-").lower())
    yield place
    place.redis.close()


@pytest.fixture
def start_worker(tmp_path_factory: pytest.TempPathFactory) -> StartWorker:
    """Start a worker of one slot, with further REFINE_ settings; afterwards nothing of it may be left."""

    def start(workplace: Workplace, **settings: str) -> AbstractContextManager[Worker]:
        return run_worker(workplace, tmp_path_factory.mktemp("worker"), **settings)

    return start
