"""How a refinement shows itself as lines and as JSON; the bar has its tests with the commands."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from refine_proto.commands.display import Display, JsonDisplay, LineDisplay, choose_display
from refine_proto.models import (
    Event,
    EventType,
    Progress,
    Refinement,
    RefinementOptions,
    SilhouetteIou,
    State,
)

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
DONE = Refinement(
    id="job-1",
    state=State.SUCCEEDED,
    options=RefinementOptions(),
    created_at=NOW,
    expires_at=NOW,
    started_at=NOW,
    finished_at=NOW + timedelta(seconds=12.34),
    silhouette_iou=SilhouetteIou(before=0.5, after=0.9),
)
Output = pytest.CaptureFixture[str]


def progress(iteration: int) -> Event:
    return Event(
        sequence=1 + iteration,
        type=EventType.PROGRESS,
        time=NOW,
        state=State.RUNNING,
        progress=Progress(iteration=iteration, total=3, percent=0, eta_s=1.6, losses={"total": 2.5}),
    )


def show(display: Display) -> None:
    with display:
        display.event(Event(sequence=1, type=EventType.STATE, time=NOW, state=State.RUNNING))
        for iteration in (1, 2, 3):
            display.event(progress(iteration))
        display.warn("the camera may look at the back")
    display.finish(DONE)
    display.written({"refined.glb": Path("out/refined.glb")})


def test_lines(capsys: Output) -> None:
    display = choose_display(as_json=False)  # pytest's standard error is no terminal
    assert isinstance(display, LineDisplay)
    show(display)
    printed, shown = capsys.readouterr()
    assert printed == "job-1 succeeded, 2D IoU 0.500 -> 0.900 in 12.3 s\nout/refined.glb\n"
    assert shown.splitlines() == [
        "running",
        "iteration 1/3  2 s left  loss 2.500  2D IoU 0.000",  # the second comes too soon
        "iteration 3/3  2 s left  loss 2.500  2D IoU 0.000",
        "warning: the camera may look at the back",
    ]


def test_json(capsys: Output) -> None:
    display = choose_display(as_json=True)
    assert isinstance(display, JsonDisplay)
    show(display)
    printed, shown = capsys.readouterr()
    assert shown == ""
    *events, warning, artifacts = map(json.loads, printed.splitlines())
    assert [event["type"] for event in events] == ["state", "progress", "progress", "progress"]
    assert warning == {"type": "warning", "warning": "the camera may look at the back"}
    assert artifacts == {"type": "artifacts", "artifacts": {"refined.glb": "out/refined.glb"}}
