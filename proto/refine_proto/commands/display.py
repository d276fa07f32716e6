"""How a refinement shows itself, on a server or in this process: a bar, lines, or JSON for programs.

What it does goes to standard error, what came of it to standard output; JSON all goes to the latter.
"""

from __future__ import annotations

import json
import sys
import time
from abc import abstractmethod
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from ..models import Event, Outcome, Progress, Refinement, State

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
        """It is on a server now."""
        print(f"{refinement.id} {refinement.state}", file=sys.stderr)

    @abstractmethod
    def event(self, event: Event) -> None:
        """It got on."""

    def warn(self, warning: str) -> None:
        """It goes on, but the result may not be what was wanted."""
        print(f"warning: {warning}", file=sys.stderr)

    def finish(self, refinement: Refinement) -> None:
        """It has succeeded."""
        iou, started, finished = refinement.silhouette_iou, refinement.started_at, refinement.finished_at
        gained = f", 2D IoU {iou.before:.3f} -> {iou.after:.3f}" if iou else ""
        kept = f" ({refinement.outcome})" if refinement.outcome not in (None, Outcome.REFINED) else ""
        took = f" in {(finished - started).total_seconds():.1f} s" if started and finished else ""
        print(f"{refinement.id} {refinement.state}{kept}{gained}{took}")

    def written(self, files: Mapping[str, Path]) -> None:
        """Its artifacts are on disk."""
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

    def warn(self, warning: str) -> None:
        self._bar.console.print(f"warning: {warning}", highlight=False, markup=False)


class LineDisplay(Display):
    """A line on standard error for every change of state, every few seconds, and for the last iteration."""

    def __enter__(self) -> Self:
        self._state: State | None = None
        self._shown = -LINE_INTERVAL_S
        return self

    def event(self, event: Event) -> None:
        if event.state is not self._state:
            self._state = event.state
            print(event.state, file=sys.stderr, flush=True)
        elif event.progress is not None and self._due(event.progress):
            progress = event.progress
            left = f"  {progress.eta_s:.0f} s left" if progress.eta_s is not None else ""
            print(
                f"iteration {progress.iteration}/{progress.total}{left}  {_values(progress)}",
                file=sys.stderr,
                flush=True,
            )

    def _due(self, progress: Progress) -> bool:
        now = time.monotonic()
        if progress.iteration < progress.total and now - self._shown < LINE_INTERVAL_S:
            return False
        self._shown = now
        return True


class JsonDisplay(Display):
    """One JSON object per line: the contract's events, `warning` between them, then `artifacts`."""

    def submitted(self, refinement: Refinement) -> None:
        return None  # the events tell, and `completed` carries all of it

    def event(self, event: Event) -> None:
        print(event.model_dump_json(exclude_none=True), flush=True)

    def warn(self, warning: str) -> None:
        print(json.dumps({"type": "warning", "warning": warning}), flush=True)

    def finish(self, refinement: Refinement) -> None:
        return None

    def written(self, files: Mapping[str, Path]) -> None:
        print(json.dumps({"type": "artifacts", "artifacts": {name: str(p) for name, p in files.items()}}))


def choose_display(as_json: bool) -> Display:
    """JSON if asked for; else a bar on a terminal, lines elsewhere."""
    if as_json:
        return JsonDisplay()
    return BarDisplay() if sys.stderr.isatty() else LineDisplay()


def _values(progress: Progress) -> str:
    loss = progress.losses.get("total")
    return (f"loss {loss:.3f}  " if loss is not None else "") + f"2D IoU {progress.silhouette_iou:.3f}"
