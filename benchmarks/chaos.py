"""Kills, stops and starves parts of an installation while jobs run, and proves that nothing was lost by it.

    python benchmarks/chaos.py --jobs 500 --seconds 600 [--seed 0] [--slots 2]

Redis, a service and a worker run as processes of their own, and each is started again when it ends, as a
service manager would do. Clients submit small jobs over REST and gRPC and write down every id that was
accepted: the ledger. Meanwhile faults hit a part at random, by a seed: SIGKILL, SIGSTOP for some seconds, or
starving, which is being stopped most of the time. At the end the ledger is compared with the final states and
every artifact is downloaded and hashed; the exit status is 1 if anything is lost, doubled, stuck or broken.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import psutil
from PIL import Image, ImageDraw
from redis import Redis
from redis.exceptions import RedisError

from refine_bench.ledger import Ledger, Verdict
from refine_client import RefineClient, RetryPolicy
from refine_jobs.embedded import find_server
from refine_proto.errors import RefineError
from refine_worker.engine.warm_up import OCTAHEDRON

CAMERA = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.6}
SETTINGS = {  # of an operator in a hurry: what is tested is whether, not when
    "REFINE_LEASE_S": "4",
    "REFINE_SLOT_TIMEOUT_S": "5",
    "REFINE_STOP_GRACE_S": "2",
    "REFINE_STALL_TIMEOUT_S": "15",
    "REFINE_READ_TIMEOUT_S": "10",
    "REFINE_MAX_ATTEMPTS": "20",
    "REFINE_REQUESTS_PER_S": "1000",
}
PATIENT = RetryPolicy(retries=1000, longest_delay_s=2)
PARTS = ("redis", "service", "worker", "slot", "engine")
AHEAD = 4  # jobs that a client has open
BACKSTAGE_S = 0.1  # between two looks at the processes
SHORTEST_STOP_S = 0.5


# ---- the installation ----


class Part:
    """A process that is started again when it ends."""

    def __init__(self, name: str, command: Sequence[str], folder: Path, settings: Mapping[str, str]) -> None:
        self.name, self._command, self._settings = name, command, settings
        self._log = folder / f"{name}.log"
        self.starts = 0
        self.start()

    def start(self) -> None:
        """Start it."""
        self.starts += 1
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                self._command,
                env=os.environ | dict(self._settings),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def stop(self) -> None:
        """End it for good."""
        self.process.send_signal(signal.SIGCONT)
        self.process.terminate()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Installation:
    """Redis, a service and a worker in a folder, kept alive by a thread."""

    def __init__(self, folder: Path, slots: int) -> None:
        http, grpc = _free_port(), _free_port()
        self.rest, self.grpc = f"http://127.0.0.1:{http}", f"grpc://127.0.0.1:{grpc}"
        self.redis_url = f"unix://{folder}/redis.sock"
        (folder / "redis").mkdir()
        redis = [find_server(), "--port", "0", "--unixsocket", f"{folder}/redis.sock", "--dir"]
        redis += [f"{folder}/redis", "--appendonly", "yes", "--save", "", "--maxmemory-policy", "noeviction"]
        settings = SETTINGS | {
            "REFINE_REDIS_URL": self.redis_url,
            "REFINE_DATA_FOLDER": str(folder / "data"),
            "REFINE_HTTP_PORT": str(http),
            "REFINE_GRPC_PORT": str(grpc),
            "REFINE_DEVICES": "cpu",
            "REFINE_SLOTS_PER_DEVICE": str(slots),
        }
        self._stopping = threading.Event()
        self.parts = {"redis": Part("redis", redis, folder, settings)}
        wait_until(lambda: Redis.from_url(self.redis_url).ping(), "Redis")
        for name in ("service", "worker"):
            self.parts[name] = Part(name, [sys.executable, "-m", f"refine_{name}"], folder, settings)
        self._keeper = threading.Thread(target=self._keep, daemon=True)
        self._keeper.start()

    def _keep(self) -> None:
        while not self._stopping.wait(BACKSTAGE_S):
            for part in self.parts.values():
                if part.process.poll() is not None:
                    part.start()

    def close(self) -> None:
        """End everything, Redis last."""
        self._stopping.set()
        self._keeper.join()
        for name in ("service", "worker", "redis"):
            self.parts[name].stop()

    def processes(self, part: str) -> list[psutil.Process]:
        """Those that a fault may hit."""
        if part in self.parts:
            return [psutil.Process(self.parts[part].process.pid)]
        module = {"slot": "refine_worker.slot.main", "engine": "refine_worker.engine"}[part]
        family = psutil.Process(self.parts["worker"].process.pid).children(recursive=True)
        return [process for process in family if module in process.cmdline()]


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def wait_until(holds: Callable[[], object], what: str, patience_s: float = 120) -> None:
    """Raises TimeoutError."""
    give_up_at = time.monotonic() + patience_s
    while time.monotonic() < give_up_at:
        with suppress(RedisError, RefineError, OSError):
            if holds():
                return
        time.sleep(BACKSTAGE_S)
    raise TimeoutError(f"waited {patience_s:g} s in vain for {what}")


# ---- clients ----


def silhouette() -> bytes:
    """A disc."""
    image = Image.new("L", (64, 64))
    ImageDraw.Draw(image).ellipse((18, 18, 46, 46), fill=255)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def submit_jobs(server: str, number: int, jobs: int, ledger: Ledger, over: threading.Event) -> None:
    """Submit jobs one after the other, up to AHEAD before those that have ended, and see them end."""
    options = {"preset": "fast", "iterations": 4, "checks": "off", "seed": 1}
    image = silhouette()
    open_ids: list[str] = []
    with RefineClient(server, retry=PATIENT) as client:
        for job in range(jobs):
            if over.is_set():
                break
            key = f"chaos-{number}-{job}"
            sent = client.submit(OCTAHEDRON, image, CAMERA, options, mesh_format="off", idempotency_key=key)
            with ledger.lock:
                ledger.accepted[sent.id] = key
            open_ids.append(sent.id)
            if len(open_ids) >= AHEAD:
                _see_end(client, open_ids.pop(0), ledger)
        for job_id in open_ids:
            _see_end(client, job_id, ledger)


def _see_end(client: RefineClient, job_id: str, ledger: Ledger) -> None:
    state = client.wait(job_id).state
    with ledger.lock:
        ledger.ended[job_id] = state
        ledger.ended_at.append(time.monotonic())


def probe(installation: Installation, ledger: Ledger, over: threading.Event) -> None:
    """Note when the service takes calls: Redis and the blob store take writes."""
    while not over.wait(BACKSTAGE_S):
        asked_at = time.monotonic()
        with suppress(OSError), urllib.request.urlopen(f"{installation.rest}/readyz", timeout=5):
            ledger.ready_at.append(asked_at)


# ---- faults ----


def make_trouble(
    installation: Installation,
    chance: random.Random,
    pause_s: float,
    longest_stop_s: float,
    ledger: Ledger,
    over: threading.Event,
) -> None:
    """One fault after the other, `pause_s` apart on average."""
    while not over.wait(chance.uniform(0.2, 1.8) * pause_s):
        part, kind = chance.choice(PARTS), chance.choice(("kill", "kill", "stop", "starve"))
        seconds = chance.uniform(SHORTEST_STOP_S, longest_stop_s)
        with suppress(psutil.NoSuchProcess):
            found = installation.processes(part)
            if not found:
                continue
            hit = chance.choice(found)
            if kind == "kill":
                hit.kill()
            elif kind == "stop":
                _stopped(hit, seconds)
            else:
                for _ in range(int(seconds)):
                    _stopped(hit, 0.9)
                    time.sleep(0.1)
        with ledger.lock:
            ledger.faults.append((time.monotonic(), part, kind))


def _stopped(process: psutil.Process, seconds: float) -> None:
    process.suspend()
    time.sleep(seconds)
    process.resume()


# ---- all of it ----


def report(ledger: Ledger, installation: Installation, took_s: float) -> Iterator[str]:
    """One line per number."""
    faults = Counter(f"{part} {kind}" for _, part, kind in ledger.faults)
    yield f"{len(ledger.accepted)} jobs accepted in {took_s:.0f} s, {len(ledger.faults)} faults"
    yield f"faults: {json.dumps(dict(sorted(faults.items())))}"
    starts = {name: part.starts for name, part in installation.parts.items()}
    yield f"processes started: {json.dumps(starts)}"
    for (part, kind), times in sorted(ledger.recoveries().items()):
        middle, worst = statistics.median(times), max(times)
        what = "ready" if part in ("redis", "service") else "a success"
        yield f"{part} {kind}: {what} after {middle:.1f} s (median of {len(times)}) to {worst:.1f} s"


@contextmanager
def running(folder: Path, slots: int) -> Iterator[Installation]:
    """An installation whose service is ready and whose slots are warm."""
    installation = Installation(folder, slots)
    try:
        with RefineClient(installation.rest, retry=PATIENT) as client:
            wait_until(lambda: client.list(limit=1), "the service")
        ready = f"{installation.rest}/readyz?slots={slots}"
        wait_until(lambda: urllib.request.urlopen(ready).status == 200, "warm slots")
        yield installation
    finally:
        installation.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", type=int, default=500, help="how many at most")
    parser.add_argument("--seconds", type=float, default=600, help="of submissions and faults")
    parser.add_argument("--settle-s", type=float, default=300, help="afterwards, for the last jobs to end")
    parser.add_argument("--pause-s", type=float, default=3, help="between two faults, on average")
    parser.add_argument("--longest-stop-s", type=float, default=12, help="of what is stopped or starved")
    parser.add_argument("--clients", type=int, default=4, help="half of them over gRPC")
    parser.add_argument("--slots", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    ledger, over = Ledger(), threading.Event()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="chaos-")))
        installation = stack.enter_context(running(folder, options.slots))
        started = time.monotonic()
        share = options.jobs // options.clients
        with ThreadPoolExecutor() as pool:
            chance = random.Random(options.seed)
            how = (chance, options.pause_s, options.longest_stop_s)
            trouble = pool.submit(make_trouble, installation, *how, ledger, over)
            prober = pool.submit(probe, installation, ledger, over)
            clients = [
                pool.submit(
                    submit_jobs, (installation.rest, installation.grpc)[n % 2], n, share, ledger, over
                )
                for n in range(options.clients)
            ]
            wait(clients, options.seconds)
            over.set()
            for thread in (*clients, trouble, prober):
                thread.result()
        took_s = time.monotonic() - started
        with RefineClient(installation.rest, retry=PATIENT) as client:
            verdict = Verdict(client, ledger, folder / "downloads", options.settle_s)
        for line in (*report(ledger, installation, took_s), *verdict.notes(), *verdict.wrong):
            print(line)
    print(f"wrong: {len(verdict.wrong)}")
    return 1 if verdict.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
