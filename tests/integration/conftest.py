"""A real Redis server, a blob folder and both faces of the job store."""

from __future__ import annotations

import itertools
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from redis import Redis

from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_jobs.edge_store import JobStore, Submitted
from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.record import Submission, Task
from refine_jobs.redis_server import connect, connect_async, connect_for_rq
from refine_jobs.settings import JobSettings
from refine_jobs.worker_store import WorkerStore
from refine_proto.models import RefinementSpec

SPEC = RefinementSpec.model_validate(
    {"camera": {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.9}}
)


@pytest.fixture(scope="session")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server.url


@pytest.fixture
def redis(redis_url: str) -> Iterator[Redis]:
    """An empty database, closed at the end."""
    with connect(redis_url) as client:
        client.flushall()
        yield client


@pytest.fixture
def rq_connection(redis: Redis, redis_url: str) -> Iterator[Redis]:
    with connect_for_rq(redis_url) as client:
        yield client


@pytest.fixture
def blobs(tmp_path: Path) -> BlobStore:
    return BlobStore(str(tmp_path / "blobs"))


class HandClock:
    """A clock that stands until it is moved."""

    def __init__(self) -> None:
        self._now_ms = 1_800_000_000_000

    def __call__(self) -> int:
        return self._now_ms

    def move(self, seconds: float) -> None:
        self._now_ms += int(seconds * 1000)


class Jobs:
    """Both faces of one job store, and the short ways that tests take."""

    def __init__(
        self, url: str, redis: Redis, blobs: BlobStore, settings: JobSettings, clock: HandClock | None = None
    ) -> None:
        self.url, self.redis, self.blobs, self.settings, self._clock = url, redis, blobs, settings, clock
        self.worker = WorkerStore(redis, settings, clock)
        self._number = itertools.count()

    def with_settings(self, **changes: object) -> Jobs:
        changed = JobSettings.model_validate(self.settings.model_dump() | changes)
        return Jobs(self.url, self.redis, self.blobs, changed, self._clock)

    def with_clock(self, clock: HandClock) -> Jobs:
        return Jobs(self.url, self.redis, self.blobs, self.settings, clock)

    @asynccontextmanager
    async def edge(self) -> AsyncIterator[JobStore]:
        store = JobStore(connect_async(self.url), self.settings, self._clock)
        try:
            yield store
        finally:
            await store.close()

    async def submit(
        self,
        store: JobStore,
        owner: str = "ann",
        key: str | None = None,
        content: bytes | None = None,
        spec: RefinementSpec = SPEC,
        task: Task = Task.REFINE,
    ) -> Submitted:
        """Upload two blobs (of `content`, or like no other) and submit them."""
        content = f"mesh {next(self._number)}".encode() if content is None else content
        job_id = await store.begin_upload(owner)
        mesh = self.blobs.put(keys.input_blob(job_id, keys.MESH), content)
        silhouette = self.blobs.put(keys.input_blob(job_id, keys.SILHOUETTE), b"png")
        return await store.submit(
            Submission(
                id=job_id,
                owner=owner,
                spec=spec,
                task=task,
                mesh=mesh,
                silhouette=silhouette,
                idempotency_key=key,
                request_id="req-1",
                traceparent="00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            )
        )

    def end_lease(self, job_id: str) -> None:
        self.redis.zadd(keys.LEASES, {job_id: 1})


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


@pytest.fixture
def jobs(redis_url: str, redis: Redis, blobs: BlobStore, tmp_path: Path) -> Jobs:
    return Jobs(redis_url, redis, blobs, JobSettings(data_folder=tmp_path))
