"""One metric over some cases, and how it is written in a table.

A gain is the change of the mean: in per cent of the mean before for distances (EMD, Chamfer-l2), a difference
for scores (F-score, IoU). Standard errors are of the mean change per case, in the metric's units.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from .methods import TITLES
from .records import Record


@dataclass(frozen=True)
class Column:
    """How a metric is written."""

    label: str
    digits: int
    relative: bool  # its gain in per cent
    smaller_is_better: bool


COLUMNS = {
    "emd": Column("EMD", 4, True, True),
    "chamfer_l2": Column("CD-l2", 2, True, True),
    "f_score": Column("F-score", 1, False, False),
    "volumetric_iou": Column("Vol. IoU", 3, False, False),
    "silhouette_iou": Column("2D IoU", 3, False, False),
}


@dataclass(frozen=True)
class Cell:
    """One metric over some cases."""

    cases: int
    before: float
    after: float
    median_before: float
    median_after: float
    standard_error: float | None  # of the mean change; None for a single case
    worse: int

    def gain(self, column: Column) -> float:
        change = self.after - self.before
        if not column.relative:
            return change
        return 100 * change / self.before if self.before else 0.0


def cell(records: Sequence[Record], metric: str) -> Cell | None:
    """None when no case has the metric."""
    pairs = _pairs(records, metric)
    if not pairs:
        return None
    before, after = ([pair[k] for pair in pairs] for k in (0, 1))
    changes = [b - a for a, b in pairs]
    sign = 1.0 if COLUMNS[metric].smaller_is_better else -1.0
    return Cell(
        len(pairs),
        statistics.fmean(before),
        statistics.fmean(after),
        statistics.median(before),
        statistics.median(after),
        statistics.stdev(changes) / len(changes) ** 0.5 if len(changes) > 1 else None,
        sum(sign * change > 0 for change in changes),
    )


def named(method: str) -> str:
    return TITLES.get(method, method)


def number(value: float, metric: str) -> str:
    return f"{value:.{COLUMNS[metric].digits}f}"


def gain(found: Cell, metric: str) -> str:
    column = COLUMNS[metric]
    gain = found.gain(column)
    return f"{gain:+.0f} %" if column.relative else f"{gain:+.{column.digits}f}"


def arrow(found: Cell | None, metric: str) -> str:
    if found is None:
        return ""
    return f"{number(found.before, metric)} -> {number(found.after, metric)} ({gain(found, metric)})"


def after(found: Cell | None, metric: str) -> str:
    return "" if found is None else f"{number(found.after, metric)} ({gain(found, metric)})"


def median(found: Cell | None, metric: str) -> str:
    if found is None:
        return ""
    return f"{number(found.median_before, metric)} -> {number(found.median_after, metric)}"


def standard_error(found: Cell | None, metric: str) -> str:
    return (
        "" if found is None or found.standard_error is None else f"± {number(found.standard_error, metric)}"
    )


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _pairs(records: Iterable[Record], metric: str) -> list[tuple[float, float]]:
    pairs = []
    for record in records:
        before = None if record.before is None else record.before.get(metric)
        after = None if record.after is None else record.after.get(metric)
        if before is not None and after is not None:
            pairs.append((before, after))
    return pairs
