"""What a slot reports to its supervisor: JSON over a pipe, one way.

The supervisor kills a slot that stops reporting, and counts the rest for the worker's metrics. A report that
finds the pipe full is dropped: a supervisor that does not read must not stop a slot.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from enum import StrEnum
from multiprocessing.connection import Connection
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from refine_jobs.slots import SlotState

from .messages import Phase

BEAT_S = 1.0  # a slot reports what it does so often
_MAX_BYTES = 4096  # of one report; so much is written whole or not at all, also by a slot that is stopped


class EngineEnd(StrEnum):
    """Why a slot needs a new engine process."""

    PLANNED = "planned"  # it has done REFINE_JOBS_PER_ENGINE jobs
    DIED = "died"  # crashed, or killed from outside
    STOPPED = "stopped"  # by its slot: a limit, a cancellation, lack of memory


class Outcome(StrEnum):
    """How an attempt ended."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    RETURNED = "returned"  # the job is queued again, through no fault of its own
    LOST = "lost"  # the lease ran out, or the engine process was killed


class _Report(BaseModel):
    model_config = ConfigDict(frozen=True)


class Beat(_Report):
    """The slot's process runs, and the job that it may have goes on."""

    type: Literal["beat"] = "beat"
    state: SlotState


class EngineStarted(_Report):
    """A new engine process is warm."""

    type: Literal["engine_started"] = "engine_started"
    seconds: float
    gpu_uuid: str | None = None


class EngineEnded(_Report):
    type: Literal["engine_ended"] = "engine_ended"
    cause: EngineEnd


class AttemptEnded(_Report):
    """With the seconds of the stages that it has reached."""

    type: Literal["attempt_ended"] = "attempt_ended"
    outcome: Outcome
    preset: str
    stages: Mapping[Phase, float]


Report = Beat | EngineStarted | EngineEnded | AttemptEnded
_REPORT: TypeAdapter[Report] = TypeAdapter(Annotated[Report, Field(discriminator="type")])


class Reports:
    """The slot's end of the pipe. Safe to use from several threads."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self._connection = Connection(descriptor, readable=False)

    def tell(self, report: Report) -> None:
        """Send it, or drop it where the supervisor is gone or behind."""
        try:
            self._connection.send_bytes(report.model_dump_json().encode())
        except OSError:
            return


def receive(connection: Connection) -> Report:
    """The next report, which is there; raises EOFError or OSError when the slot is gone."""
    return _REPORT.validate_json(connection.recv_bytes(_MAX_BYTES))
