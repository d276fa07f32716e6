r"""Jobs in every state as some version of the code left them, in one file.

    git archive COMMIT | tar x -C OLD
    PYTHONPATH=OLD/engine:OLD/proto:OLD/jobs:OLD/service:OLD/worker:OLD/client \
        python tests/support/job_dump.py tests/faults/dumps/COMMIT.zip

The file has keys.json, what Redis held, without what belongs to its version, and the blobs.
"""

from __future__ import annotations

import json
import signal
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import Any

from redis import Redis
from sample import CAMERA, MESH, SILHOUETTE
from service_process import run_service
from worker_process import Workplace, run_worker, wait_until

from refine_client import RefineClient
from refine_jobs import keys
from refine_jobs.embedded import EmbeddedRedis

BY_TIME = (keys.LEASES, keys.EXPIRY, keys.QUEUED_SINCE, keys.UPLOADS)  # sorted sets whose scores are times
PASSING = ("rq:worker", "rq:clean", keys.SLOT, keys.SLOTS, keys.PROBE)  # of processes that are gone


def write(path: Path) -> None:
    """Make jobs that succeeded, failed, were cancelled, run on a slot that is gone, and wait."""
    with tempfile.TemporaryDirectory() as name, EmbeddedRedis(Path(name) / "redis") as server:
        folder = Path(name)
        place = Workplace(server.url, folder)
        (folder / "worker").mkdir()
        with (
            run_service(server.url, folder) as service,
            service.client("rest") as client,
            run_worker(place, folder / "worker") as worker,
        ):
            ids = {
                "succeeded": submit(client, iterations=4),
                "failed": submit(client, mesh=b"v 0 0 0\nf 1 1 1\n"),
                "cancelled": submit(client, iterations=10_000),
            }
            wait_until(lambda: client.get(ids["cancelled"]).progress, "progress")
            client.cancel(ids["cancelled"])
            for state, job_id in ids.items():
                assert client.wait(job_id).state == state
            ids["running"] = submit(client, iterations=20)
            wait_until(lambda: client.get(ids["running"]).progress, "progress")
            ids["queued"] = submit(client, iterations=4)
            for process in worker.tree():
                process.send_signal(signal.SIGKILL)
            worker.process.wait()
        _write(path, server.url, folder, ids)


def submit(client: RefineClient, mesh: bytes | None = None, **options: Any) -> str:
    """The id."""
    options = {"preset": "fast", **options}
    mesh = mesh or MESH.read_bytes()
    return client.submit(mesh, SILHOUETTE.read_bytes(), CAMERA, options, mesh_format="obj").id


def _write(path: Path, url: str, folder: Path, ids: dict[str, str]) -> None:
    with _connect(url) as redis:
        names = [name for name in redis.scan_iter() if not name.startswith(PASSING)]
        dump = {
            "ids": ids,
            "time_ms": int(time.time() * 1000),
            "keys": {name: [redis.type(name), _read(redis, name)] for name in sorted(names)},
        }
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("keys.json", json.dumps(dump, indent=1))
        for blob in sorted((folder / "blobs").rglob("*")):
            if blob.is_file():
                archive.write(blob, str(blob.relative_to(folder)))


def _connect(url: str) -> Any:
    """RQ's values are compressed: bytes are letters here."""
    return Redis.from_url(url, decode_responses=True, encoding="latin-1")


def _read(redis: Any, name: str) -> Any:
    match redis.type(name):
        case "string":
            return redis.get(name)
        case "hash":
            return redis.hgetall(name)
        case "list":
            return redis.lrange(name, 0, -1)
        case "set":
            return sorted(redis.smembers(name))
        case "zset":
            return dict(redis.zrange(name, 0, -1, withscores=True))
        case _:
            return redis.xrange(name)


def load(path: Path, redis_url: str, data_folder: Path) -> dict[str, str]:
    """Put it into an empty Redis and a data folder, as if it had been written just now; ids by state."""
    with zipfile.ZipFile(path) as archive:
        dump = json.loads(archive.read("keys.json"))
        archive.extractall(data_folder, [name for name in archive.namelist() if name.startswith("blobs/")])
    since_ms = int(time.time() * 1000) - dump["time_ms"]
    with _connect(redis_url) as redis:
        for name, (kind, value) in dump["keys"].items():
            _load(redis, name, kind, value, since_ms)
    return dict(dump["ids"])


def _load(redis: Any, name: str, kind: str, value: Any, since_ms: int) -> None:
    match kind:
        case "string":
            redis.set(name, value)
        case "hash":
            times = {k: int(v) + since_ms for k, v in value.items() if k.endswith("_ms")}
            redis.hset(name, mapping=value | times if name.startswith(keys.JOB) else value)
        case "list":
            redis.rpush(name, *value)
        case "set":
            redis.sadd(name, *value)
        case "zset":
            by = since_ms if name in BY_TIME else 0
            redis.zadd(name, {member: score + by for member, score in value.items()})
        case _:
            for entry_id, fields in value:
                redis.xadd(name, fields, id=entry_id)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
