"""The real service in a process of its own, and a worker played by hand through the real WorkerStore."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
import struct
import subprocess
import sys
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil
from judgement import JUDGEMENT
from redis import Redis

from refine_client import RefineClient, RetryPolicy
from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_jobs.record import Job, Task
from refine_jobs.settings import JobSettings
from refine_jobs.slots import SlotState, SlotStatus
from refine_jobs.worker_store import WorkerStore
from refine_proto.formats import ARTIFACTS
from refine_proto.models import Artifact, Progress

MESH = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
CAMERA = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 2}


def png(width: int = 8, height: int = 8) -> bytes:
    """A grey image with a bright square; the pixels of one that announces to be large are missing."""
    rows = [bytes([0] + [255 if 2 <= x < 6 and 2 <= y < 6 else 0 for x in range(8)]) for y in range(8)]
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(b"".join(rows))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


PNG = png()


@dataclass(frozen=True)
class Service:
    """Where a running service is."""

    rest_url: str
    grpc_address: str
    process: subprocess.Popen[str]
    data_folder: Path
    log_path: Path

    def rest(self, key: str | None = None) -> httpx.Client:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx.Client(base_url=self.rest_url, headers=headers, timeout=60)

    def client(self, transport: str, key: str | None = None) -> RefineClient:
        """The SDK over "rest" or "grpc"; it tries once."""
        server = self.rest_url if transport == "rest" else f"grpc://{self.grpc_address}"
        return RefineClient(server, api_key=key, retry=RetryPolicy(retries=0))

    @property
    def http_address(self) -> tuple[str, int]:
        """Host and port, for sockets."""
        url = httpx.URL(self.rest_url)
        assert url.port is not None
        return url.host, url.port

    def stop(self) -> int:
        """SIGTERM and the exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(60)

    def log(self) -> list[dict[str, Any]]:
        """The lines of its log."""
        return [json.loads(line) for line in self.log_path.read_text().splitlines()]

    def open_connections(self, port: int) -> int:
        """How many callers are connected to one of its ports."""
        found = psutil.Process(self.process.pid).net_connections("tcp")
        return sum(each.status == psutil.CONN_ESTABLISHED and each.laddr.port == port for each in found)

    def peak_memory_bytes(self) -> int:
        """The most resident memory it ever had (Linux)."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        kib = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
        return int(kib) * 1024


@contextmanager
def run_service(
    redis_url: str,
    folder: Path,
    settings: Mapping[str, object] | None = None,
    descriptors: int | None = None,
) -> Iterator[Service]:
    """A service on free ports with REFINE_* settings given without the prefix, and so many open files."""
    folder.mkdir(parents=True, exist_ok=True)
    values = {
        "redis_url": redis_url,
        "data_folder": folder,
        "http_port": 0,
        "grpc_port": 0,
        **(settings or {}),
    }
    environment = {name: value for name, value in os.environ.items() if not name.startswith("REFINE_")}
    environment |= {f"REFINE_{name.upper()}": str(value) for name, value in values.items()}
    log_path = folder / "service.log"
    command = [sys.executable, "-W", "error", "-m", "refine_service"]

    def limit_descriptors() -> None:
        if descriptors is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))

    with log_path.open("w") as log:
        process = subprocess.Popen(
            command,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            preexec_fn=limit_descriptors,
        )
    assert process.stdout is not None
    try:
        words = process.stdout.readline().split()
        assert len(words) == 4, log_path.read_text()
        yield Service(words[1], words[3], process, folder, log_path)
    finally:
        if process.poll() is None:
            process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


class Hand:
    """A worker slot whose every step is taken by the test."""

    def __init__(self, redis: Redis, data_folder: Path) -> None:
        settings = JobSettings(data_folder=data_folder)
        self.redis = redis
        self.store = WorkerStore(redis, settings)
        self.blobs = BlobStore(settings.blob_location)
        self._queue = f"rq:queue:{keys.queue('default')}"

    def start(self, refinement_id: str) -> Job:
        """Take it out of RQ's list, as RQ's worker would, and claim it."""
        for delivery in self.redis.lrange(self._queue, 0, -1):
            if str(delivery).rpartition("-")[0] == refinement_id:
                self.redis.lrem(self._queue, 0, str(delivery))
        job = self.store.claim(refinement_id, "slot-0")
        assert job is not None
        return job

    def report(self, job: Job, iteration: int, total: int = 10) -> None:
        progress = Progress(iteration=iteration, total=total, percent=100 * iteration / total)
        self.store.report(job, progress)

    def finish(self, job: Job, contents: Mapping[str, bytes]) -> list[Artifact]:
        """Succeed with these artifacts, by name."""
        artifacts = [
            Artifact(
                name=name,
                media_type=ARTIFACTS[name],
                size_bytes=len(data),
                sha256=hashlib.sha256(data).hexdigest(),
            )
            for name, data in contents.items()
        ]
        for name, data in contents.items():
            self.blobs.put(keys.artifact_blob(job.id, job.attempt, name), data)
        self.store.finish(job, artifacts, JUDGEMENT)
        return artifacts

    def run(self, refinement_id: str, contents: Mapping[str, bytes]) -> Job:
        """Start and succeed."""
        job = self.start(refinement_id)
        self.finish(job, contents)
        return job

    @contextmanager
    def answering(self, act: Callable[[Job], object]) -> Iterator[list[Job]]:
        """Inside, a thread takes every question in front of the queue and does `act`; the jobs it took."""
        taken: list[Job] = []
        over = threading.Event()

        def work() -> None:
            while not over.wait(0.02):
                front = str(self.redis.lindex(self._queue, 0) or "").rpartition("-")[0]
                if self.redis.hget(keys.JOB + front, "task") not in (None, Task.REFINE):
                    taken.append(self.start(front))
                    act(taken[-1])

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield taken
        finally:
            over.set()
            thread.join()

    def expire(self, refinement_id: str) -> None:
        """Let its lifetime be over."""
        self.redis.hset(keys.JOB + refinement_id, "expires_ms", "1")
        self.redis.zadd(keys.EXPIRY, {refinement_id: 1})
        assert self.store.expire() == [refinement_id]

    def show_slot(self, state: SlotState = SlotState.IDLE) -> None:
        self.store.show(SlotStatus(name="slot-0", device="cpu", state=state))
