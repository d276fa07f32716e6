"""A simulated queue and autoscaler: python benchmarks/autoscale.py [--job-s S] [--cold-s S] [--seed N]

Eight hours of jobs: a few, and bursts. Prints for each policy how long jobs waited and its worker hours;
deploy/README.md says what follows for the chart's defaults. A worker that is taken away ends its jobs first.
"""

from __future__ import annotations

import argparse
import math
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

HOURS = 8
STEP_S = 1
POLL_S = 15  # KEDA's pollingInterval


@dataclass(frozen=True)
class World:
    """What no policy decides: seconds of a job and of a worker's start, slots of a worker, most workers."""

    job_s: float
    cold_s: float
    slots: int
    most: int


@dataclass(frozen=True)
class Seen:
    """What the autoscaler knows at a poll."""

    queued: int
    age_s: float  # of the oldest queued job
    busy_slots: int


@dataclass
class Worker:
    """One pod; `busy_until` holds the end of each running job."""

    warm_at: float
    busy_until: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Policy:
    """How many workers are wanted; fewer only when fewer were wanted for `patience_s`."""

    name: str
    wanted: Callable[[Seen], float]
    least: int
    patience_s: float = 300


def arrivals(rng: random.Random) -> list[float]:
    """Times: one job a minute, and each hour a burst of 100 to 400 jobs within two minutes."""
    times = [rng.uniform(0, HOURS * 3600) for _ in range(HOURS * 60)]
    for hour in range(HOURS):
        start = hour * 3600 + rng.uniform(0, 3000)
        times += [start + rng.uniform(0, 120) for _ in range(rng.randint(100, 400))]
    return sorted(times)


def simulate(policy: Policy, world: World, seed: int) -> tuple[list[float], float]:
    """Waiting times of all jobs, and worker hours, from the order of a pod to its end."""
    rng = random.Random(seed)
    coming, queue = deque(arrivals(rng)), deque[float]()
    workers = [Worker(0.0) for _ in range(policy.least)]
    draining: list[Worker] = []
    recent: deque[tuple[float, int]] = deque()  # what was wanted within the patience
    waits: list[float] = []
    worker_s, now = 0.0, 0.0
    while coming or queue or now < HOURS * 3600:
        while coming and coming[0] <= now:
            queue.append(coming.popleft())
        for worker in (*workers, *draining):
            worker.busy_until = [end for end in worker.busy_until if end > now]
        draining = [worker for worker in draining if worker.busy_until]
        for worker in workers:
            while queue and worker.warm_at <= now and len(worker.busy_until) < world.slots:
                waits.append(now - queue.popleft())
                worker.busy_until.append(now + world.job_s * rng.uniform(0.5, 1.5))
        if now % POLL_S == 0:
            busy = sum(len(worker.busy_until) for worker in workers)
            seen = Seen(len(queue), now - queue[0] if queue else 0.0, busy)
            wanted = min(world.most, max(policy.least, math.ceil(policy.wanted(seen))))
            recent.append((now, wanted))
            while recent[0][0] < now - policy.patience_s:
                recent.popleft()
            target = max(count for _, count in recent)
            workers += [Worker(now + world.cold_s) for _ in range(target - len(workers))]
            while len(workers) > target:  # like Kubernetes, which does not know who is busy
                draining.append(workers.pop(rng.randrange(len(workers))))
        worker_s += STEP_S * (len(workers) + len(draining))
        now += STEP_S
    return waits, worker_s / 3600


def policies(world: World) -> list[Policy]:
    """Those that the chart can express, and fixed numbers beside them."""

    def by_length(jobs: float) -> Callable[[Seen], float]:
        return lambda seen: seen.queued / jobs

    def by_age(seconds: float) -> Callable[[Seen], float]:
        return lambda seen: seen.age_s / seconds

    def either(seen: Seen) -> float:
        return max(by_length(2 * world.slots)(seen), by_age(60)(seen))

    return [
        Policy("1 worker, fixed", lambda seen: 1, 1),
        Policy(f"{world.most} workers, fixed", lambda seen: world.most, world.most),
        Policy("age / 60 s, from 0", by_age(60), 0),
        Policy("age / 30 s, from 0", by_age(30), 0),
        Policy("length / slots, from 0", by_length(world.slots), 0),
        Policy("length / 2 slots, from 0", by_length(2 * world.slots), 0),
        Policy("age / 60 s or length / 2 slots, from 0", either, 0),
        Policy("the same, from 1", either, 1),
        Policy("the same, from 1, down after 60 s", either, 1, 60),
        Policy("the same, from 1, down after 900 s", either, 1, 900),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--job-s", type=float, default=35, help="of one job on one slot, on average")
    parser.add_argument(
        "--cold-s", type=float, default=60, help="from the order of a worker to its first job"
    )
    parser.add_argument("--slots", type=int, default=4, help="of one worker")
    parser.add_argument("--most", type=int, default=10, help="workers")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    world = World(given.job_s, given.cold_s, given.slots, given.most)
    print("| policy | half waited, s | 95 % | longest | worker hours |\n|---|---:|---:|---:|---:|")
    for policy in policies(world):
        waits, hours = simulate(policy, world, given.seed)
        ordered = sorted(waits)
        half, most = (ordered[int(share * (len(ordered) - 1))] for share in (0.5, 0.95))
        print(f"| {policy.name} | {half:.0f} | {most:.0f} | {ordered[-1]:.0f} | {hours:.1f} |")


if __name__ == "__main__":
    main()
