"""How fairly slots are shared: python benchmarks/fairness.py [--slots N]

Jobs of several owners go through the job store on a Redis of its own; slots are simulated, and a job takes as
long as it was estimated to. The fair time of a job is that of an ideal server, which works on the jobs of all
owners at once and gives each owner the same share. Prints for each mix how much longer the worst job took,
with fair shares and first come, first served.
"""

from __future__ import annotations

import argparse
import asyncio
import heapq
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from refine_jobs.blobs import Blob
from refine_jobs.delivery import Delivery
from refine_jobs.edge_store import JobStore
from refine_jobs.embedded import EmbeddedRedis
from refine_jobs.record import Submission
from refine_jobs.redis_server import connect, connect_async
from refine_jobs.settings import JobSettings
from refine_jobs.share import estimated_cost_ms
from refine_jobs.worker_store import WorkerStore
from refine_proto.models import (
    Judgement,
    Outcome,
    Preset,
    Priority,
    RefinementOptions,
    RefinementSpec,
    SilhouetteIou,
)

CAMERA = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.9}
SETTINGS = JobSettings(max_queued=100_000, max_queued_per_owner=100_000)
JUDGEMENT = Judgement(silhouette_iou=SilhouetteIou(before=0.5, after=0.9), outcome=Outcome.REFINED)
MESH_BYTES = 90_000  # 1,500 vertices


@dataclass(frozen=True)
class Arrival:
    """A job that somebody submits."""

    at_s: float
    owner: str
    preset: Preset = Preset.DEFAULT
    priority: Priority = Priority.NORMAL

    @property
    def spec(self) -> RefinementSpec:
        options = RefinementOptions(preset=self.preset, priority=self.priority)
        return RefinementSpec.model_validate({"camera": CAMERA, "options": options})

    @property
    def run_s(self) -> float:
        return estimated_cost_ms(self.spec, MESH_BYTES) / 1000


def pile(owner: str, jobs: int, at_s: float = 0, preset: Preset = Preset.DEFAULT) -> list[Arrival]:
    return [Arrival(at_s, owner, preset) for _ in range(jobs)]


def lots(jobs: int, owners: int, presets: Sequence[Preset] = (Preset.DEFAULT,)) -> list[Arrival]:
    return [
        Arrival(0, f"owner {owner}", presets[owner % len(presets)])
        for _ in range(jobs)
        for owner in range(owners)
    ]


MIXES: dict[str, list[Arrival]] = {
    "500 jobs of one owner, then 1 of another": [*pile("many", 500), Arrival(60, "single")],
    "3 jobs of each of 100 owners, then 1 of a new one": [*lots(3, 100), Arrival(60, "single")],
    "the same, `fast`, default and `paper`": [*lots(3, 100, list(Preset)), Arrival(60, "single")],
    "100 `fast` jobs of one owner and 20 `paper` jobs of another": [
        *pile("long", 20, preset=Preset.PAPER),
        *pile("short", 100, preset=Preset.FAST),
    ],
    "10 jobs of each of 20 owners, then 1 low, 1 normal, 1 high": [
        *lots(10, 20),
        *(Arrival(60, f"{priority} priority", priority=priority) for priority in Priority),
    ],
}


class Clock:
    """Simulated time for the job store."""

    now_s = 0.0

    def __call__(self) -> int:
        return int(self.now_s * 1000) + 1_800_000_000_000


def simulate(
    arrivals: Sequence[Arrival],
    slots: int,
    submit: Callable[[int], None],
    take: Callable[[], int | None],
    clock: Clock,
) -> list[float]:
    """Seconds from submission to end of each job."""
    coming = sorted(range(len(arrivals)), key=lambda n: arrivals[n].at_s)[::-1]
    running: list[tuple[float, int]] = []
    took = [0.0] * len(arrivals)
    clock.now_s = 0.0
    while coming or running:
        while coming and arrivals[coming[-1]].at_s <= clock.now_s:
            submit(coming.pop())
        while len(running) < slots and (number := take()) is not None:
            heapq.heappush(running, (clock.now_s + arrivals[number].run_s, number))
        ends = running[0][0] if running else float("inf")
        if coming and arrivals[coming[-1]].at_s < ends:
            clock.now_s = arrivals[coming[-1]].at_s
        else:
            clock.now_s, number = heapq.heappop(running)
            took[number] = clock.now_s - arrivals[number].at_s
    return took


def first_come(arrivals: Sequence[Arrival], slots: int) -> list[float]:
    queue: list[int] = []
    return simulate(arrivals, slots, queue.append, lambda: queue.pop(0) if queue else None, Clock())


def fair_shares(arrivals: Sequence[Arrival], slots: int, url: str) -> list[float]:
    """Through the job store; every slot takes RQ's first delivery."""
    clock = Clock()
    ids: dict[str, int] = {}
    list_key = Delivery(SETTINGS.pool).queue.key
    with asyncio.Runner() as runner, connect(url) as redis:
        redis.flushall()
        worker = WorkerStore(redis, SETTINGS, clock)
        store = runner.run(_open(url, clock))

        def submit(number: int) -> None:
            arrival = arrivals[number]
            ids[runner.run(_submit(store, arrival))] = number

        def take() -> int | None:
            delivery = redis.lpop(list_key)
            job = worker.claim(str(delivery).rpartition("-")[0], "slot") if delivery else None
            if job is None:
                return None
            worker.finish(job, [], JUDGEMENT)
            return ids[job.id]

        took = simulate(arrivals, slots, submit, take, clock)
        runner.run(store.close())
    return took


async def _submit(store: JobStore, arrival: Arrival) -> str:
    upload, blob = await store.begin_upload(arrival.owner), Blob(MESH_BYTES, "0" * 64)
    await store.submit(
        Submission(id=upload, owner=arrival.owner, spec=arrival.spec, mesh=blob, silhouette=blob)
    )
    return upload


async def _open(url: str, clock: Clock | None = None) -> JobStore:
    return JobStore(connect_async(url), SETTINGS, clock)


def ideal(arrivals: Sequence[Arrival], slots: int, step_s: float = 1.0) -> list[float]:
    """All owners at once, each with the same share of the slots, each job on one slot at most."""
    left = [arrival.run_s for arrival in arrivals]
    took = [0.0] * len(arrivals)
    now_s = 0.0
    while any(left):
        owners: dict[str, list[int]] = {}
        for number, arrival in enumerate(arrivals):
            if left[number] and arrival.at_s <= now_s:
                owners.setdefault(arrival.owner, []).append(number)
        free = float(slots)
        for place, jobs in enumerate(sorted(owners.values(), key=len)):  # who needs least first
            share = min(len(jobs), free / (len(owners) - place))
            free -= share
            for number in jobs:
                rate = min(1.0, share)
                share -= rate
                left[number] = max(0.0, left[number] - rate * step_s)
                if not left[number]:
                    took[number] = now_s + step_s - arrivals[number].at_s
        now_s += step_s
    return took


def price(url: str, queued: int = 10_000, calls: int = 50) -> tuple[float, float]:
    """Milliseconds of Redis' CPU time: a submission, a cancellation, with so many jobs in the queue."""
    arrivals = lots(queued // 100, 100)

    async def steps() -> tuple[float, float]:
        store = await _open(url)
        sent = [await _submit(store, arrival) for arrival in arrivals]
        before_s = cpu_s()
        for arrival in arrivals[:calls]:
            await _submit(store, arrival)
        between_s = cpu_s()
        for arrival, job_id in zip(arrivals[:calls], sent, strict=False):
            await store.cancel(arrival.owner, job_id)
        after_s = cpu_s()
        await store.close()
        return 1000 * (between_s - before_s) / calls, 1000 * (after_s - between_s) / calls

    with connect(url) as redis:

        def cpu_s() -> float:
            used = redis.info("cpu")
            return float(used["used_cpu_user"]) + float(used["used_cpu_sys"])

        redis.flushall()
        return asyncio.run(steps())


def main() -> None:
    parser = argparse.ArgumentParser(description="How fairly slots are shared.")
    parser.add_argument("--slots", type=int, default=4)
    slots = parser.parse_args().slots
    print("| mix | worst job | fair, s | fair shares, s | over fair | first come, s | over fair |")
    print("|---|---|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder, EmbeddedRedis(Path(folder)) as server:
        for name, arrivals in MIXES.items():
            fair = ideal(arrivals, slots)
            ours, former = fair_shares(arrivals, slots, server.url), first_come(arrivals, slots)
            shown = {max(range(len(arrivals)), key=lambda n: ours[n] / fair[n])}
            shown |= {n for n, arrival in enumerate(arrivals) if arrival.at_s}
            for n in sorted(shown, key=lambda n: -ours[n] / fair[n]):
                who = arrivals[n].owner
                print(
                    f"| {name} | {who} | {fair[n]:.0f} | {ours[n]:.0f} | {ours[n] / fair[n]:.2f} "
                    f"| {former[n]:.0f} | {former[n] / fair[n]:.2f} |"
                )
                name = ""
        submit_ms, cancel_ms = price(server.url)
        print(
            f"\nRedis' CPU time with 10,000 queued jobs of 100 owners: {submit_ms:.1f} ms a submission, "
            f"{cancel_ms:.1f} ms a cancellation"
        )


if __name__ == "__main__":
    main()
