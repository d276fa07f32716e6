"""How a watched refinement shows itself: a live bar on a terminal, lines elsewhere, JSON for programs."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from refine_proto.models import Event, Progress, Refinement, State

LINE_INTERVAL_S = 5.0


class Display(AbstractContextManager["Display"]):
    """Shows the events of one refinement while it is entered, and what came of it afterwards."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def submitted(self, refinement: Refinement) -> None:
        print(f"{refinement.id} {refinement.state}", file=sys.stderr)

    def event(self, event: Event) -> None:
        raise NotImplementedError

    def finish(self, refinement: Refinement) -> None:
        iou = refinement.silhouette_iou
        gained = f", 2D IoU {iou.before:.3f} -> {iou.after:.3f}" if iou is not None else ""
        print(f"{refinement.id} {refinement.state}{gained}")

    def downloaded(self, files: Mapping[str, Path]) -> None:
        for path in files.values():
            print(path)


class BarDisplay(Display):
    """A live bar on standard error: state, iterations, time left, total loss, 2D IoU."""

    def __enter__(self) -> Self:
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[values]}"),
            console=Console(stderr=True),
        )
        self._task = self._bar.add_task(State.QUEUED, total=None, values="")
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def event(self, event: Event) -> None:
        self._bar.update(self._task, description=str(event.state))
        if (progress := event.progress) is not None:
            self._bar.update(
                self._task, completed=progress.iteration, total=progress.total, values=_values(progress)
            )


class LineDisplay(Display):
    """A line on standard error for every change of state, and every few seconds."""

    def __enter__(self) -> Self:
        self._state: State | None = None
        self._shown = 0.0
        return self

    def event(self, event: Event) -> None:
        now, progress = time.monotonic(), event.progress
        if event.state is not self._state:
            self._state = event.state
            print(event.state, file=sys.stderr, flush=True)
        elif progress is not None and now - self._shown >= LINE_INTERVAL_S:
            self._shown = now
            left = f"  {progress.eta_s:.0f} s left" if progress.eta_s is not None else ""
            print(
                f"iteration {progress.iteration}/{progress.total}{left}  {_values(progress)}",
                file=sys.stderr,
                flush=True,
            )


class JsonDisplay(Display):
    """One JSON object per line on standard output: the events of the contract, then `artifacts`."""

    def submitted(self, refinement: Refinement) -> None:
        return None  # the events tell, and `completed` carries all of it

    def event(self, event: Event) -> None:
        print(event.model_dump_json(exclude_none=True), flush=True)

    def finish(self, refinement: Refinement) -> None:
        return None

    def downloaded(self, files: Mapping[str, Path]) -> None:
        print(json.dumps({"type": "artifacts", "artifacts": {name: str(p) for name, p in files.items()}}))


def choose_display(as_json: bool) -> Display:
    if as_json:
        return JsonDisplay()
    return BarDisplay() if sys.stderr.isatty() else LineDisplay()


def _values(progress: Progress) -> str:
    loss = progress.losses.get("total")
    return (f"loss {loss:.3f}  " if loss is not None else "") + f"2D IoU {progress.silhouette_iou:.3f}"
