"""What a worker slot says of itself, for readiness and metrics."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from refine_proto.open_enum import OpenEnum


class SlotState(OpenEnum):
    """What a slot is doing."""

    STARTING = "starting"
    IDLE = "idle"
    BUSY = "busy"
    DRAINING = "draining"

    @property
    def can_work(self) -> bool:
        """Whether the slot has a warm engine and does jobs."""
        return self in (SlotState.IDLE, SlotState.BUSY)


class SlotStatus(BaseModel):
    """One worker slot: a process that refines one mesh at a time."""

    model_config = ConfigDict(frozen=True)

    name: str
    device: str
    state: SlotState
    job_id: str | None = None
