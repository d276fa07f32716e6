"""What waits and runs at one moment, and when a job is therefore expected to end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from . import keys
from .record import Job

LOAD_VALUES = 6  # answers to the commands of ask_load


def ask_load(pipe: Any) -> None:
    """The commands whose answers `read_load` takes; they cost the same however many jobs wait."""
    pipe.time()
    pipe.zcard(keys.QUEUED)
    pipe.get(keys.QUEUED_COST)
    pipe.zcard(keys.LEASES)
    pipe.zrange(keys.SLOTS, 0, -1, withscores=True)
    pipe.get(keys.PACE)


def read_load(answers: Sequence[Any]) -> Load:
    """The answers, in order."""
    (seconds, micros), queued, cost_ms, running, slots, pace = answers
    return Load(
        now=datetime.fromtimestamp(seconds + micros / 1e6, UTC),
        queued=queued,
        queued_cost_ms=int(cost_ms or 0),
        running=running,
        slots=sum(expiry >= seconds for _, expiry in slots),
        pace=float(pace) if pace else None,
    )


@dataclass(frozen=True)
class Load:
    """Jobs and slots, all owners together."""

    now: datetime
    queued: int
    queued_cost_ms: int
    running: int
    slots: int  # that are alive
    pace: float | None  # milliseconds of a run for one of its estimated cost, lately; None before the first

    def eta_s(self, job: Job, rank: int | None) -> float | None:
        """Seconds until the job is expected to end; `rank` of the queued. None where nothing tells."""
        if self.pace is None or job.cost_ms is None:
            return None
        run_s = job.cost_ms * self.pace / 1000
        if rank is not None:
            return round(self._wait_s(rank, self.pace) + run_s, 1) if self.slots else None
        if job.state.terminal or job.started_at is None:
            return None
        if job.progress is not None and job.progress.eta_s is not None:
            return job.progress.eta_s
        return round(max(0.0, run_s - (self.now - job.started_at).total_seconds()), 1)

    def _wait_s(self, rank: int, pace: float) -> float:
        """Slots that are all busy end one job in each n-th part of the mean run."""
        must_end = max(0, rank + 1 - max(0, self.slots - self.running))
        return must_end * self.queued_cost_ms * pace / 1000 / self.queued / self.slots if must_end else 0.0
