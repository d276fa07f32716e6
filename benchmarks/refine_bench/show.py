"""How a run shows itself: a bar with the running means on a terminal, a line per result elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .records import Record


class Show:
    """Progress on standard error. A bar on a terminal; lines otherwise."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[means]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._done: list[Record] = []

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def start(self, total: int, earlier: Sequence[Record]) -> None:
        self._done = [record for record in earlier if record.status == "done"]
        if earlier:
            self.say(f"{len(earlier)} results are there already; {total} are left")
        self._task = self._bar.add_task("", total=total, means=running_means(self._done))

    def add(self, record: Record) -> None:
        if record.status == "done":
            self._done.append(record)
        else:
            self.say(f"{record.status}: {record.case}: {record.message}")
        self._bar.update(self._task, advance=1, means=running_means(self._done))
        if self._bar.disable and record.status == "done":
            self.say(f"{record.case} {record.method} {record.seconds:.1f} s: {running_means([record])}")

    def say(self, message: str) -> None:
        if self._bar.disable:
            print(message, file=sys.stderr, flush=True)
        else:
            self._bar.console.print(message, highlight=False, markup=False)


def running_means(records: Sequence[Record]) -> str:
    """Chamfer-l2, F-score and 2D IoU of the results so far, before -> after."""
    parts = []
    for label, name, digits in (
        ("CD", "chamfer_l2", 2),
        ("F", "f_score", 1),
        ("2D IoU", "silhouette_iou", 3),
    ):
        pairs = [
            (r.before[name], r.after[name])
            for r in records
            if r.before is not None and r.after is not None and r.before[name] is not None
        ]
        if pairs:
            before, after = (
                sum(v or 0.0 for v in column) / len(pairs) for column in zip(*pairs, strict=True)
            )
            parts.append(f"{label} {before:.{digits}f} -> {after:.{digits}f}")
    return "  ".join(parts)
