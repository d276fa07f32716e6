"""Numbers of the service on this machine: python benchmarks/service.py [submit watch memory overhead redis]

Starts a Redis, a service and, for `overhead` and `redis`, a worker of its own in a temporary folder. Prints
one line per number; what they should be is in docs/operating.md.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from refine_client import RefineClient
from refine_jobs import keys
from refine_jobs.blobs import BlobStore
from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.redis_server import connect
from refine_jobs.settings import JobSettings
from refine_jobs.worker_store import WorkerStore
from refine_proto.formats import ARTIFACTS, ArtifactName
from refine_proto.models import Artifact, Judgement, Outcome, Progress, SilhouetteIou, State

SAMPLE = Path(__file__).parents[1] / "examples/samples/chair"
CAMERA = json.loads((SAMPLE / "camera.json").read_text())
SILHOUETTE = (SAMPLE / "silhouette.png").read_bytes()
MIB = 2**20
JUDGEMENT = Judgement(silhouette_iou=SilhouetteIou(before=0.5, after=0.9), outcome=Outcome.REFINED)


@dataclass(frozen=True)
class Installation:
    """A Redis and a service, without a worker."""

    redis_url: str
    folder: Path
    process: subprocess.Popen[str]
    rest: str
    grpc: str

    @property
    def address(self) -> tuple[str, int]:
        host, _, port = self.rest.removeprefix("http://").rpartition(":")
        return host, int(port)

    def memory_mb(self) -> float:
        return psutil.Process(self.process.pid).memory_info().rss / 1e6

    def peak_memory_mb(self) -> float:
        """Linux only: elsewhere nobody keeps the peak."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6


def environment(redis_url: str, folder: Path) -> dict[str, str]:
    return {
        **os.environ,
        "REFINE_REDIS_URL": redis_url,
        "REFINE_DATA_FOLDER": str(folder),
        "REFINE_HTTP_PORT": "0",
        "REFINE_GRPC_PORT": "0",
        "REFINE_MAX_QUEUED_PER_OWNER": "10000",
    }


@contextmanager
def installation() -> Iterator[Installation]:
    with tempfile.TemporaryDirectory() as name, EmbeddedRedis(Path(name) / "redis") as redis:
        folder = Path(name)
        values = environment(redis.url, folder)
        with (folder / "service.log").open("w") as log:
            command = [sys.executable, "-m", "refine_service"]
            process = subprocess.Popen(command, env=values, stdout=subprocess.PIPE, stderr=log, text=True)
        assert process.stdout is not None
        _, rest, _, grpc = process.stdout.readline().split()
        try:
            yield Installation(redis.url, folder, process, rest, grpc)
        finally:
            process.terminate()
            process.wait()


# ---- submissions ----


def submission(mesh_bytes: int) -> bytes:
    """One HTTP request, ready to send: what counts is the service's time, not a client's."""
    mesh = (SAMPLE / "coarse.obj").read_bytes()
    mesh = mesh[: mesh.rfind(b"\n", 0, mesh_bytes) + 1].ljust(mesh_bytes, b"#")
    parts = (
        ('name="mesh"; filename="coarse.obj"', mesh),
        ('name="silhouette"; filename="silhouette.png"', SILHOUETTE),
        ('name="camera"', json.dumps(CAMERA).encode()),
    )
    body = b"".join(
        b"--b\r\nContent-Disposition: form-data; %s\r\n\r\n%s\r\n" % (n.encode(), d) for n, d in parts
    )
    body += b"--b--\r\n"
    head = (
        "POST /v1/refinements HTTP/1.1\r\nHost: localhost\r\n"
        f"Content-Type: multipart/form-data; boundary=b\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body


async def submit(service: Installation, clients: int = 100, each: int = 20) -> None:
    """100 clients, one connection each, every one posting as soon as it has its answer."""
    request = submission(100_000)
    seconds: list[float] = []
    statuses: Counter[int] = Counter()

    async def client() -> None:
        reader, writer = await asyncio.open_connection(*service.address)
        for _ in range(each):
            started = time.perf_counter()
            writer.write(request)
            head = await reader.readuntil(b"\r\n\r\n")
            length = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
            await reader.readexactly(length)
            seconds.append(time.perf_counter() - started)
            statuses[int(head.split()[1])] += 1
        writer.close()

    started = time.perf_counter()
    await asyncio.gather(*(client() for _ in range(clients)))
    rate = len(seconds) / (time.perf_counter() - started)
    p50, p99 = (statistics.quantiles(seconds, n=100)[at] for at in (49, 98))
    print(
        f"submit: {rate:.0f} accepted per second, p50 {p50:.2f} s, p99 {p99:.2f} s, statuses {dict(statuses)}"
    )


# ---- watchers ----


async def watch(service: Installation, watchers: int = 500) -> None:
    """Event streams of one job, which a worker played by hand runs."""
    with connect(service.redis_url) as redis, RefineClient(service.rest) as client:
        worker = WorkerStore(redis, JobSettings(data_folder=service.folder))
        refinement = client.submit(SAMPLE / "coarse.obj", SILHOUETTE, CAMERA)
        request = f"GET /v1/refinements/{refinement.id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        before, opened, completed = service.memory_mb(), asyncio.Semaphore(0), 0

        async def watcher() -> None:
            nonlocal completed
            reader, writer = await asyncio.open_connection(*service.address)
            writer.write(request)
            await reader.readuntil(b"event: state")
            opened.release()
            await reader.readuntil(b"event: completed")
            completed += 1
            writer.close()

        tasks = [asyncio.create_task(watcher()) for _ in range(watchers)]
        for _ in tasks:
            await opened.acquire()
        while_open = service.memory_mb()
        job = worker.claim(refinement.id, "by-hand")
        assert job is not None
        for iteration in range(10):
            worker.report(job, Progress(iteration=iteration, total=10, percent=10.0 * iteration))
        ended = time.perf_counter()
        worker.finish(job, [], JUDGEMENT)
        await asyncio.gather(*tasks)
    print(
        f"watch: {completed} of {watchers} watchers got the end, within {time.perf_counter() - ended:.2f} s; "
        f"resident {before:.0f} MB before, {while_open:.0f} MB open, {service.peak_memory_mb():.0f} MB peak"
    )


# ---- memory ----


def memory(service: Installation) -> None:
    """60 MB up and down through each transport."""
    mesh = service.folder / "coarse.obj"
    mesh.write_bytes((SAMPLE / "coarse.obj").read_bytes().ljust(60 * MIB, b"#"))
    blobs = BlobStore(str(service.folder / "blobs"))
    for server in (service.rest, f"grpc://{service.grpc}"):
        with connect(service.redis_url) as redis, RefineClient(server) as client:
            worker = WorkerStore(redis, JobSettings(data_folder=service.folder))
            client.submit(SAMPLE / "coarse.obj", SILHOUETTE, CAMERA)
            before = service.peak_memory_mb()
            refinement = client.submit(mesh, SILHOUETTE, CAMERA)
            up = service.peak_memory_mb()
            job = worker.claim(refinement.id, "by-hand")
            assert job is not None
            name = ArtifactName.REFINED
            blob = blobs.put(keys.artifact_blob(job.id, job.attempt, name), mesh.read_bytes())
            artifact = Artifact(name=name, media_type=ARTIFACTS[name], **vars(blob))
            worker.finish(job, [artifact], JUDGEMENT)
            client.download(refinement.id, service.folder / refinement.id)
            down = service.peak_memory_mb()
        transport = server.partition("://")[0]
        print(f"memory over {transport}: 60 MB up: {up - before:.1f} MB more, down: {down - up:.1f} MB more")


# ---- overhead ----


@contextmanager
def one_slot(service: Installation) -> Iterator[None]:
    """A worker with one slot while inside."""
    values = {**environment(service.redis_url, service.folder), "REFINE_SLOTS_PER_DEVICE": "1"}
    with (service.folder / "worker.log").open("w") as log:
        worker = subprocess.Popen([sys.executable, "-m", "refine_worker"], env=values, stdout=log, stderr=log)
        try:
            yield
        finally:
            worker.terminate()
            worker.wait()


def overhead(service: Installation, jobs: int = 10) -> None:
    """What a job of 20 iterations takes beyond the engine's own time, on a warm slot."""
    if importlib.util.find_spec("refine_worker") is None:
        print("overhead: not measured, refine_worker is not installed")
        return
    spans: dict[str, list[float]] = {"in all": [], "until the start": [], "worker": [], "edge and client": []}
    with one_slot(service), RefineClient(service.rest) as client:
        for number in range(jobs + 1):
            started = time.perf_counter()
            sent = client.submit(SAMPLE / "coarse.obj", SILHOUETTE, CAMERA, {"iterations": 20})
            ended = client.wait(sent.id, timeout_s=600)
            took = time.perf_counter() - started
            assert ended.state is State.SUCCEEDED, ended.error
            assert ended.started_at is not None
            assert ended.finished_at is not None
            files = client.download(sent.id, service.folder / sent.id, names=["report.json"])
            engine_s = json.loads(files["report.json"].read_text())["seconds"]
            queued_s = (ended.started_at - ended.created_at).total_seconds()
            run_s = (ended.finished_at - ended.started_at).total_seconds()
            values_s = (took - engine_s, queued_s, run_s - engine_s, took - queued_s - run_s)
            for span, seconds in zip(spans.values(), values_s, strict=True):
                if number:  # the first pays the start of the worker
                    span.append(seconds)
    medians = ", ".join(f"{name} {1000 * statistics.median(span):.0f} ms" for name, span in spans.items())
    print(f"overhead beyond the engine's own time, medians of {jobs} jobs: {medians}")


# ---- Redis ----


def redis_cost(service: Installation, jobs: int = 10) -> None:
    """Memory that an ended job keeps until it expires, and commands from submission to end."""
    with one_slot(service), connect(service.redis_url) as redis, RefineClient(service.rest) as client:

        def run() -> None:
            sent = client.submit(SAMPLE / "coarse.obj", SILHOUETTE, CAMERA, {"preset": "fast"})
            assert client.wait(sent.id, timeout_s=600).state is State.SUCCEEDED

        def calls() -> int:  # with those inside scripts
            return sum(int(command["calls"]) for command in redis.info("commandstats").values())

        run()  # pays the start of the worker
        time.sleep(2 * keys.SLOT_S)
        before, idle = calls(), time.monotonic()
        time.sleep(keys.SLOT_S)
        idle_per_s = (calls() - before) / (time.monotonic() - idle)
        memory, before, started = redis.info("memory")["used_memory"], calls(), time.monotonic()
        for _ in range(jobs):
            run()
        took = time.monotonic() - started
        counted = calls() - before - idle_per_s * took
        grown = redis.info("memory")["used_memory"] - memory
        largest = sorted(
            (int(redis.memory_usage(key) or 0), key.rstrip("0123456789abcdef-")) for key in redis.scan_iter()
        )
    print(
        f"redis: {grown / jobs / 1e3:.1f} kB and {counted / jobs:.0f} commands per job of {took / jobs:.1f} s"
    )
    print(f"redis: {idle_per_s:.1f} commands per second without jobs; largest keys {largest[-3:]}")


MEASURES: dict[str, Callable[[Installation], None]] = {
    "submit": lambda service: asyncio.run(submit(service)),
    "watch": lambda service: asyncio.run(watch(service)),
    "memory": memory,
    "overhead": overhead,
    "redis": redis_cost,
}


def main() -> None:
    for name in sys.argv[1:] or MEASURES:
        with installation() as service:
            MEASURES[name](service)


if __name__ == "__main__":
    main()
