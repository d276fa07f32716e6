"""A backup of Redis and blobs, taken while the service runs, gives every job back on an empty machine."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from service_process import CAMERA, MESH, PNG, Hand, run_service

from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.redis_server import connect


def test_jobs_survive_a_restore(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    with (
        EmbeddedRedis(here / "redis") as server,
        run_service(server.url, here) as service,
        connect(server.url) as redis,
        service.client("rest") as client,
    ):
        ended, waits = (client.submit(MESH, PNG, CAMERA, mesh_format="obj") for _ in range(2))
        Hand(redis, here).run(ended.id, {"refined.glb": b"refined"})
        redis.config_set("auto-aof-rewrite-percentage", 0)
        redis.bgrewriteaof()
        while redis.info("persistence")["aof_rewrite_in_progress"]:
            time.sleep(0.02)
        shutil.copytree(here / "redis/appendonlydir", there / "redis/appendonlydir")
        shutil.copytree(here / "blobs", there / "blobs")  # after Redis: a job that it knows has its files
    with (
        EmbeddedRedis(there / "redis") as server,
        run_service(server.url, there) as service,
        connect(server.url) as redis,
        service.client("rest") as client,
    ):
        files = client.download(ended.id, tmp_path / "out")
        assert files["refined.glb"].read_bytes() == b"refined"
        Hand(redis, there).run(waits.id, {})
        assert client.get(waits.id).state == "succeeded"
