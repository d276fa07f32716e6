"""Workers, and the places in which they work; worker_process.py has both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from worker_process import StartWorker, Worker, Workplace, run_worker, wait_until

from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.slots import SlotState


@pytest.fixture(scope="session")
def redis_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Its URL."""
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server.url


@pytest.fixture(scope="session")
def workplace(redis_server: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workplace]:
    """Of the worker that most tests share."""
    place = Workplace(redis_server, tmp_path_factory.mktemp("workplace"))
    yield place
    place.redis.close()


@pytest.fixture
def own_workplace(redis_server: str, tmp_path: Path) -> Iterator[Workplace]:
    """A queue and a blob folder that no other test uses."""
    place = Workplace(redis_server, tmp_path, pool=tmp_path.name.replace("_", "-").lower())
    yield place
    place.redis.close()


@pytest.fixture(scope="session")
def start_worker(tmp_path_factory: pytest.TempPathFactory) -> StartWorker:
    """Start a worker of one slot, with further REFINE_ settings; afterwards nothing of it may be left."""

    def start(workplace: Workplace, **settings: str) -> AbstractContextManager[Worker]:
        return run_worker(workplace, tmp_path_factory.mktemp("worker"), **settings)

    return start


@pytest.fixture(scope="session")
def _shared_worker(start_worker: StartWorker, workplace: Workplace) -> Iterator[Worker]:
    # A machine that runs other tests too may need seconds for one iteration.
    with start_worker(workplace, cancel_grace_s="4") as worker:
        yield worker


@pytest.fixture
def worker(_shared_worker: Worker) -> Worker:
    """The worker that most tests share; its slot is warm and idle."""
    worker = _shared_worker
    wait_until(lambda: [slot.state for slot in worker.slots()] == [SlotState.IDLE], "an idle slot")
    return worker
