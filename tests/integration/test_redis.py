"""The embedded server, the demands on any server, and what happens when it is away."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest
from pydantic import ValidationError
from redis import Redis

from refine_jobs import durable, embedded, keys
from refine_jobs.edge_store import JobStore
from refine_jobs.embedded import EmbeddedRedis, EmbeddedRedisError, find_server
from refine_jobs.health import Health
from refine_jobs.reaper import reap
from refine_jobs.redis_server import RedisUnfit, check_server, connect, connect_async
from refine_jobs.settings import JobSettings
from refine_jobs.slots import SlotState, SlotStatus
from refine_proto.errors import Unavailable
from refine_proto.models import Refinement, State

if TYPE_CHECKING:
    from .conftest import HandClock, Jobs


def test_data_survives_a_restart(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server, connect(server.url) as client:
        check_server(client)
        client.set("kept", "yes")
    with EmbeddedRedis(tmp_path) as server, connect(server.url) as client:
        assert client.get("kept") == "yes"


def test_one_process_per_folder(tmp_path: Path) -> None:
    with (
        EmbeddedRedis(tmp_path),
        pytest.raises(EmbeddedRedisError, match="another process"),
        EmbeddedRedis(tmp_path),
    ):
        pass


PARENT = """
import sys, time
from pathlib import Path
from redis import Redis
from refine_jobs.embedded import EmbeddedRedis
with EmbeddedRedis(Path(sys.argv[1])) as server:
    client = Redis.from_url(server.url)
    client.set("kept", "yes")
    print(client.info()["process_id"], flush=True)
    time.sleep(600)
"""


@contextmanager
def killed_parent(folder: Path) -> Iterator[tuple[int, psutil.Process]]:
    """The server and the guard of a process that is killed at the end."""
    with subprocess.Popen(
        [sys.executable, "-c", PARENT, str(folder)], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout
        server = int(parent.stdout.readline())
        [guard] = [child for child in psutil.Process(parent.pid).children() if child.pid != server]
        yield server, guard
        parent.kill()


def test_the_server_of_a_killed_parent_ends(tmp_path: Path) -> None:
    with killed_parent(tmp_path) as (server, guard):
        pass
    with pytest.raises(ProcessLookupError):
        _wait_for_end(server)
    psutil.wait_procs([guard], timeout=20)
    assert not guard.is_running() or guard.status() == psutil.STATUS_ZOMBIE
    assert not Path((tmp_path / "socket").read_text()).exists()


def test_who_holds_the_lifeline_keeps_the_server(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server, connect(server.url) as client:
        user = subprocess.Popen(["sleep", "600"], pass_fds=[server.lifeline])
        pid = client.info()["process_id"]
        try:
            assert server._guard
            assert server._guard.stdin
            server._guard.stdin.close()  # as if this process had ended
            time.sleep(0.5)
            assert client.ping()
        finally:
            user.kill()
            user.wait()
        with pytest.raises(ProcessLookupError):
            _wait_for_end(pid)


def test_a_server_whose_guard_was_killed_too_is_replaced(tmp_path: Path) -> None:
    with killed_parent(tmp_path) as (orphan, guard):
        guard.kill()
    os.kill(orphan, 0)  # still runs
    with EmbeddedRedis(tmp_path) as server, connect(server.url) as client:
        assert client.info()["process_id"] != orphan
        assert client.get("kept") == "yes"
        with pytest.raises(ProcessLookupError):
            _wait_for_end(orphan)


def _wait_for_end(pid: int) -> None:
    for _ in range(200):
        os.kill(pid, 0)
        stat = Path(f"/proc/{pid}/stat")
        if stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            raise ProcessLookupError(pid)  # ended; nobody has reaped it in this container
        time.sleep(0.05)


def test_a_server_that_cannot_start_shows_its_log(tmp_path: Path) -> None:
    (tmp_path / "appendonlydir").write_text("a file is in the way")
    with (
        pytest.raises(EmbeddedRedisError, match=r"(?s)log ends with:\n.*append-only dir"),
        EmbeddedRedis(tmp_path),
    ):
        pass


def test_an_evicting_server_is_refused(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server, connect(server.url) as client:
        client.config_set("maxmemory-policy", "allkeys-lru")
        with pytest.raises(RedisUnfit, match="allkeys-lru"):
            check_server(client)


def test_a_server_that_could_lose_what_was_accepted_is_refused(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server, connect(server.url) as client:
        client.config_set("appendonly", "no")
        with pytest.raises(RedisUnfit, match="append-only file"):
            check_server(client)
        check_server(client, sync_submissions=False)


def test_a_server_too_old_to_wait_for_its_disk_has_to_sync_every_write(
    jobs: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = shutil.which("redis-server")
    version = subprocess.run([older, "--version"], capture_output=True, text=True).stdout if older else ""
    if not re.search(r"v=(6\.2|7\.[01])\.", version):
        pytest.skip("needs a redis-server of 6.2, 7.0 or 7.1 on PATH (Debian 12 has one)")
    monkeypatch.setattr(embedded, "find_server", lambda: older)

    async def submit(url: str) -> State:
        store = JobStore(connect_async(url), JobSettings(data_folder=tmp_path))
        try:
            return (await jobs.submit(store)).refinement.state
        finally:
            await store.close()

    with EmbeddedRedis(tmp_path / "redis") as server, connect(server.url) as client:
        with pytest.raises(RedisUnfit, match=r"appendfsync always, got \S+ with everysec"):
            check_server(client)
        client.config_set("appendfsync", "always")
        check_server(client)
        assert asyncio.run(submit(server.url)) is State.QUEUED


def test_what_redis_has_not_on_its_disk_is_not_accepted(
    jobs: Jobs, redis: Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that takes longer than anybody waits; what was queued all the same is found by its key."""
    monkeypatch.setattr(durable, "_PATIENCE_S", 0.1)

    async def scenario() -> None:
        async with jobs.with_settings(sync_submissions=True).edge() as store:
            redis.config_set("appendfsync", "no")  # nothing is ever known to be there
            with pytest.raises(Unavailable, match="same idempotency key"):
                await jobs.submit(store, key="k", content=b"mesh")
            redis.config_set("appendfsync", "everysec")
            again = await jobs.submit(store, key="k", content=b"mesh")
            assert again.replayed

    asyncio.run(scenario())


def test_ctrl_c_does_not_reach_the_server(redis: Redis) -> None:
    assert os.getpgid(redis.info()["process_id"]) != os.getpgid(0)
    assert Path(find_server()).name in ("valkey-server", "redis-server")


def test_a_redis_that_is_away_is_unavailable(jobs: Jobs, tmp_path: Path) -> None:
    async def scenario() -> None:
        with EmbeddedRedis(tmp_path / "redis") as server:
            client = connect_async(server.url)
            store, health = JobStore(client, jobs.settings), Health(client)
            job_id = (await _jobs_at(jobs, store)).id
            os.kill(connect(server.url).info()["process_id"], signal.SIGKILL)
            for call in (store.get("ann", job_id), store.begin_upload("ann"), health.check_writable()):
                with pytest.raises(Unavailable) as caught:
                    await call
                assert caught.value.retry_after_s
            await store.close()

    asyncio.run(scenario())


async def _jobs_at(jobs: Jobs, store: JobStore) -> Refinement:
    return (await jobs.submit(store)).refinement


def test_blobs_that_redis_has_forgotten_are_swept(jobs: Jobs, redis: Redis) -> None:
    async def submit() -> str:
        async with jobs.edge() as store:
            return (await jobs.submit(store)).refinement.id

    known, forgotten, young = (asyncio.run(submit()) for _ in range(3))
    redis.delete(keys.JOB + forgotten, keys.JOB + young)
    long_ago = time.time() - jobs.settings.retention_s - keys.UPLOAD_S - 1
    place = jobs.settings.data_folder / "blobs"
    for job_id in (known, forgotten):
        folder = place / keys.blob_folder(job_id)
        (folder / "input" / "mesh#1").write_bytes(b"half-written")
        for path in (folder, *folder.rglob("*")):
            os.utime(path, (long_ago, long_ago))
    assert reap(jobs.worker, jobs.blobs).swept == 1
    assert jobs.blobs.folders(keys.BLOBS) == sorted([known, young])
    assert reap(jobs.worker, jobs.blobs).swept == 0  # not again within the hour


def test_a_flush_of_the_scripts_goes_unnoticed(jobs: Jobs, redis: Redis) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            for _ in range(2):
                redis.script_flush()
                job_id = (await jobs.submit(store)).refinement.id
                redis.script_flush()
                job = jobs.worker.claim(job_id, "slot-0")
                assert job
                redis.script_flush()
                jobs.worker.cancelled(job)

    asyncio.run(scenario())


def test_health_shows_slots_and_counts(jobs: Jobs) -> None:
    async def scenario() -> None:
        async with jobs.edge() as store:
            client = connect_async(jobs.url)
            health = Health(client)
            await health.check_writable()
            assert await health.slots() == ()
            slot = SlotStatus(name="slot-0", device="cpu", state=SlotState.IDLE)
            jobs.worker.show(slot)
            assert await health.slots() == (slot,)

            done, failed, _ = [(await jobs.submit(store)).refinement.id for _ in range(3)]
            first, second = jobs.worker.claim(done, "slot-0"), jobs.worker.claim(failed, "slot-0")
            assert first
            assert second
            jobs.worker.cancelled(first)
            jobs.worker.give_back(second, "it stops")
            told = await health.installation()
            assert (told.queued, told.running, told.redis_persists) == (2, 0, True)
            counts = told.counters
            assert (counts["jobs:cancelled:"], counts["requeued:returned"]) == (1, 1)
            assert counts["submitted:refinements"] == 3
            buckets = [v for name, v in counts.items() if name.startswith("queue_s:") and "sum" not in name]
            assert sum(buckets) == 2

            jobs.worker.hide("slot-0")
            assert await health.slots() == ()
            jobs.worker.show(SlotStatus(name="slot-1", device="cpu", state=SlotState("resting")))
            [newer] = await health.slots()  # of a newer version
            assert (newer.state, newer.state in list(SlotState)) == ("resting", False)
            await client.aclose()

    asyncio.run(scenario())


def test_the_delay_of_the_queue_is_that_of_the_job_that_waits_longest(
    jobs: Jobs, clock: HandClock, redis: Redis
) -> None:
    async def scenario() -> None:
        timed = jobs.with_clock(clock)
        clock.move(time.time() - clock() / 1000 - 500)  # 500 s ago
        async with timed.edge() as store, connect_async(jobs.url) as client:
            health = Health(client)

            async def age_s() -> float:
                return (await health.installation()).oldest_queued_age_s

            assert await age_s() == 0
            first, second = [(await timed.submit(store)).refinement.id for _ in range(2)]
            assert await age_s() == pytest.approx(500, abs=30)
            clock.move(400)
            job = timed.worker.claim(first, "slot-0")
            assert job
            timed.worker.give_back(job, "it stops")  # in front of the second, which has waited longer
            assert await age_s() == pytest.approx(500, abs=30)
            await store.delete("ann", second)
            assert await age_s() == pytest.approx(100, abs=30)
            job = timed.worker.claim(first, "slot-0")
            assert job
            assert await age_s() == 0
            assert redis.zcard(keys.QUEUED_SINCE) == 0
            assert (
                redis.hget(keys.METRICS, "queue_s:sum_ms") == "400000"
            )  # nobody waited for the second start

    asyncio.run(scenario())


def test_settings_come_from_the_environment_and_keep_secrets() -> None:
    settings = JobSettings.from_environment(
        {
            "REFINE_REDIS_URL": "redis://:s3cret@host/1",
            "REFINE_MAX_QUEUED": "7",
            "REFINE_BLOB_URL": "",
            "HOME": "/",
        }
    )
    assert settings.redis_url
    assert settings.redis_url.get_secret_value() == "redis://:s3cret@host/1"
    assert (settings.max_queued, settings.blob_url) == (7, None)
    assert "s3cret" not in repr(settings)
    with pytest.raises(ValidationError, match="lease_s"):
        JobSettings.from_environment({"REFINE_LEASE_S": "soon"})
