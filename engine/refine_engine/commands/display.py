"""How a run shows itself: a progress bar on a terminal, lines elsewhere, JSON for programs."""

from __future__ import annotations

import json
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ..values import Progress as Report
from ..values import Result

LINE_INTERVAL_S = 5.0
JSON_INTERVAL_S = 0.5


class Display(ABC):
    """Shows the reports of one run while it is entered, and its result afterwards."""

    def __enter__(self) -> Self:
        self.started = self.shown = time.monotonic()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    @abstractmethod
    def report(self, report: Report) -> None: ...

    def warn(self, warning: str) -> None:
        print(f"warning: {warning}", file=sys.stderr)

    def finish(self, result: Result, artifacts: Mapping[str, Path]) -> None:
        before, after = result.silhouette_iou_before, result.silhouette_iou_after
        print(f"2D IoU {before:.3f} -> {after:.3f} in {result.seconds:.1f} s")
        for path in artifacts.values():
            print(path)

    def due(self, report: Report, interval_s: float) -> bool:
        """Whether to show this report: the last one, and otherwise at most one every `interval_s`."""
        now = time.monotonic()
        if report.iteration < report.total and now - self.shown < interval_s:
            return False
        self.shown = now
        return True

    def eta_s(self, report: Report) -> float:
        elapsed = time.monotonic() - self.started
        return elapsed * (report.total - report.iteration) / report.iteration


class BarDisplay(Display):
    """A live bar on standard error: iterations, time left, total loss, 2D IoU."""

    def __enter__(self) -> Self:
        self.bar = Progress(
            TextColumn("refining"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("loss {task.fields[loss]}  2D IoU {task.fields[iou]}"),
            console=Console(stderr=True),
        )
        self.task = self.bar.add_task("refining", total=None, loss="-", iou="-")
        self.bar.start()
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    def report(self, report: Report) -> None:
        self.bar.update(
            self.task,
            total=report.total,
            completed=report.iteration,
            loss=f"{report.losses['total']:.3f}",
            iou=f"{report.silhouette_iou:.3f}",
        )

    def warn(self, warning: str) -> None:
        self.bar.console.print(f"warning: {warning}", highlight=False, markup=False)


class LineDisplay(Display):
    """A line on standard error every few seconds."""

    def report(self, report: Report) -> None:
        if self.due(report, LINE_INTERVAL_S):
            print(
                f"iteration {report.iteration}/{report.total}  {self.eta_s(report):.0f} s left  "
                f"loss {report.losses['total']:.3f}  2D IoU {report.silhouette_iou:.3f}",
                file=sys.stderr,
            )


class JsonDisplay(Display):
    """One JSON object per line on standard output: events `progress`, `warning` and one `completed`."""

    def report(self, report: Report) -> None:
        if self.due(report, JSON_INTERVAL_S):
            self._print(
                event="progress",
                iteration=report.iteration,
                total=report.total,
                percent=round(100 * report.iteration / report.total, 1),
                eta_s=round(self.eta_s(report), 1),
                losses=dict(report.losses),
                silhouette_iou=report.silhouette_iou,
            )

    def warn(self, warning: str) -> None:
        self._print(event="warning", warning=warning)

    def finish(self, result: Result, artifacts: Mapping[str, Path]) -> None:
        self._print(
            event="completed",
            silhouette_iou={"before": result.silhouette_iou_before, "after": result.silhouette_iou_after},
            best_iteration=result.best_iteration,
            seconds=round(result.seconds, 3),
            warnings=list(result.warnings),
            artifacts={name: str(path) for name, path in artifacts.items()},
        )

    def _print(self, **event: object) -> None:
        print(json.dumps(event), flush=True)


def choose_display(as_json: bool) -> Display:
    if as_json:
        return JsonDisplay()
    return BarDisplay() if sys.stderr.isatty() else LineDisplay()
