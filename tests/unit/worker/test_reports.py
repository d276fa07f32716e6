"""The pipe from a slot to its supervisor."""

from __future__ import annotations

import os
from multiprocessing import Pipe

import pytest

from refine_jobs.slots import SlotState
from refine_worker.messages import Phase
from refine_worker.reports import (
    AttemptEnded,
    Beat,
    EngineEnd,
    EngineEnded,
    EngineStarted,
    Outcome,
    Report,
    Reports,
    receive,
)


def test_what_is_told_is_received() -> None:
    ours, theirs = Pipe(duplex=False)
    reports = Reports(os.dup(theirs.fileno()))
    theirs.close()
    told: list[Report] = [
        Beat(state=SlotState.IDLE),
        EngineStarted(seconds=7.5, gpu_uuid="8a2e"),
        EngineEnded(cause=EngineEnd.DIED),
        AttemptEnded(outcome=Outcome.FAILED, preset="fast", stages={Phase.READ: 0.5}),
    ]
    with ours:
        for report in told:
            reports.tell(report)
        assert [receive(ours) for _ in told] == told
        del reports
        with pytest.raises(EOFError):
            receive(ours)


def test_a_supervisor_that_does_not_read_stops_no_slot() -> None:
    ours, theirs = Pipe(duplex=False)
    reports = Reports(os.dup(theirs.fileno()))
    theirs.close()
    beat = Beat(state=SlotState.IDLE)
    with ours:
        for _ in range(10_000):  # more than a pipe holds
            reports.tell(beat)
        assert receive(ours) == beat
    reports.tell(beat)  # and one that is gone neither
