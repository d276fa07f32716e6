"""The paper's tables from the records of a run: per category, and method against method.

A gain is the change of the mean: in per cent of the mean before for distances (EMD, Chamfer-l2), a difference
for scores (F-score, IoU). Standard errors are of the mean change per case, in the metric's units. A case is
made worse when its Chamfer-l2 grew, or without ground truth when its 2D IoU fell.
"""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from .methods import ABLATION, ASYMMETRIC_ONLY, TITLES
from .records import METRICS, Record, without_seeds


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
NONE = "none"  # the coarse meshes, as a row beside the methods


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


def tables_markdown(records: Sequence[Record], title: str) -> str:
    """Everything that a run measured, as one document."""
    averaged = without_seeds(records)
    parts = [f"# {title}", _legend(records)]
    methods = _in_order(r.method for r in averaged)
    levels = _in_order(r.level for r in averaged)
    if len(methods) > 1:
        parts += _comparisons(averaged, methods, levels)
    for method in methods:
        own = [r for r in averaged if r.method == method]
        parts += [f"## {_named(method)}", by_category(own)]
        for level in levels if len(levels) > 1 else ():
            parts += [f"### {level}", by_category([r for r in own if r.level == level])]
    if len({r.seed for r in records if r.status == "done"}) > 1:
        parts += ["## Spread over seeds", seed_spread(records)]
    parts += _not_done(records)
    return "\n\n".join(parts) + "\n"


def by_category(records: Sequence[Record]) -> str:
    """Category x metric, before -> after (gain), then the mean, the median and how sure the change is."""
    metrics = [name for name in METRICS if cell(records, name) is not None]
    rows = [
        [category, str(len(chosen)), *(_arrow(cell(chosen, name), name) for name in metrics)]
        for (category,), chosen in _by(records, "category")
    ]
    total = {name: cell(records, name) for name in metrics}
    rows.append(["**mean**", str(len(records)), *(f"**{_arrow(total[name], name)}**" for name in metrics)])
    rows.append(["median", "", *(_median(total[name], name) for name in metrics)])
    rows.append(["standard error", "", *(_standard_error(total[name], name) for name in metrics)])
    rows.append(["made worse", "", *(f"{c.worse} of {c.cases}" for c in total.values() if c is not None)])
    return _markdown(["category", "n", *(COLUMNS[name].label for name in metrics)], rows)


def comparison(records: Sequence[Record], methods: Sequence[str]) -> str:
    """Method x metric: the means over the cases that all the methods did, so that they compare."""
    sets = [{r.case for r in records if r.method == method} for method in methods]
    common = set.intersection(*sets)
    chosen = [r for r in records if r.case in common]
    metrics = [name for name in METRICS if cell(chosen, name) is not None]
    first = [r for r in chosen if r.method == methods[0]]
    rows = [[NONE, *(_number(c.before, name) for name in metrics if (c := cell(first, name))), ""]]
    for method in methods:
        own = [r for r in chosen if r.method == method]
        cells = {name: cell(own, name) for name in metrics}
        rows.append([_named(method), *(_after(cells[name], name) for name in metrics), _worse(own)])
    return _markdown(
        [f"method (n = {len(common)})", *(COLUMNS[m].label for m in metrics), "made worse"], rows
    )


def seed_spread(records: Sequence[Record]) -> str:
    """Per method the mean over cases for each seed: its mean over the seeds, and their standard deviation."""
    rows = []
    done = [r for r in records if r.status == "done"]
    for (method,), own in _by(done, "method"):
        seeds = [chosen for _, chosen in _by(own, "seed")]
        row = [_named(method), str(len(seeds))]
        for name in METRICS:
            means = [c.after for chosen in seeds if (c := cell(chosen, name))]
            spread = statistics.stdev(means) if len(means) > 1 else 0.0
            row.append(f"{_number(statistics.fmean(means), name)} ± {_number(spread, name)}" if means else "")
        rows.append(row)
    return _markdown(["method", "seeds", *(COLUMNS[name].label for name in METRICS)], rows)


def tables_csv(records: Sequence[Record]) -> str:
    """The cells of all tables, one per line, numbers unrounded."""
    stream = io.StringIO()
    header = ("method", "level", "category", "metric", "cases", "before", "after", "gain", "gain_unit")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*header, "median_before", "median_after", "standard_error", "worse"])
    averaged = without_seeds(records)
    for (method, level), group in _by(averaged, "method", "level"):
        for (category,), chosen in (*_by(group, "category"), (("all",), group)):
            for name, column in COLUMNS.items():
                if found := cell(chosen, name):
                    unit = "per cent" if column.relative else "difference"
                    row = (method, level, category, name, found.cases, found.before, found.after)
                    gain = (found.gain(column), unit, found.median_before, found.median_after)
                    writer.writerow([*row, *gain, found.standard_error, found.worse])
    return stream.getvalue()


def _comparisons(records: Sequence[Record], methods: Sequence[str], levels: Sequence[str]) -> list[str]:
    """All methods on all cases; then per level; then both lambda_B on the asymmetric cases."""
    general = [method for method in methods if method != ASYMMETRIC_ONLY]
    parts = ["## Methods side by side", comparison(records, general)] if len(general) > 1 else []
    for level in levels if len(levels) > 1 and len(general) > 1 else ():
        parts += [f"### {level}", comparison([r for r in records if r.level == level], general)]
    if ASYMMETRIC_ONLY in methods and "all" in methods:
        asymmetric = [r for r in records if r.asymmetric]
        parts += ["## Asymmetric objects", comparison(asymmetric, ["all", ASYMMETRIC_ONLY])]
    return parts


def _legend(records: Sequence[Record]) -> str:
    done = sum(r.status == "done" for r in records)
    return (
        f"{done} results of {len({r.case for r in records})} cases. Before -> after (gain). EMD and CD-l2 "
        "(x 1000): smaller is better, gain in per cent; F-score (%), volumetric and 2D IoU: larger is "
        "better, gain as a difference."
    )


def _not_done(records: Sequence[Record]) -> list[str]:
    problems = [r for r in records if r.status != "done"]
    if not problems:
        return []
    lines = [f"- {r.case} ({_named(r.method)}): {r.status}: {r.message}" for r in problems]
    return ["## Not measured", "\n".join(lines)]


def _worse(records: Sequence[Record]) -> str:
    found = cell(records, "chamfer_l2") or cell(records, "silhouette_iou")
    return "" if found is None else f"{found.worse} of {found.cases}"


def _pairs(records: Iterable[Record], metric: str) -> list[tuple[float, float]]:
    pairs = []
    for record in records:
        before = None if record.before is None else record.before.get(metric)
        after = None if record.after is None else record.after.get(metric)
        if before is not None and after is not None:
            pairs.append((before, after))
    return pairs


def _by(records: Sequence[Record], *fields: str) -> list[tuple[tuple[str, ...], list[Record]]]:
    """Groups of records that agree in the fields, sorted by them."""
    groups: dict[tuple[str, ...], list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(str(getattr(record, field)) for field in fields), []).append(record)
    return sorted(groups.items())


def _in_order(names: Iterable[str]) -> list[str]:
    """Each once: the ablation in its own order, the others as they first came."""
    unique = list(dict.fromkeys(names))
    return sorted(unique, key=lambda name: ABLATION.index(name) if name in ABLATION else -1)


def _named(method: str) -> str:
    return TITLES.get(method, method)


def _number(value: float, metric: str) -> str:
    return f"{value:.{COLUMNS[metric].digits}f}"


def _gain(found: Cell, metric: str) -> str:
    column = COLUMNS[metric]
    gain = found.gain(column)
    return f"{gain:+.0f} %" if column.relative else f"{gain:+.{column.digits}f}"


def _arrow(found: Cell | None, metric: str) -> str:
    if found is None:
        return ""
    return f"{_number(found.before, metric)} -> {_number(found.after, metric)} ({_gain(found, metric)})"


def _after(found: Cell | None, metric: str) -> str:
    return "" if found is None else f"{_number(found.after, metric)} ({_gain(found, metric)})"


def _median(found: Cell | None, metric: str) -> str:
    if found is None:
        return ""
    return f"{_number(found.median_before, metric)} -> {_number(found.median_after, metric)}"


def _standard_error(found: Cell | None, metric: str) -> str:
    return (
        "" if found is None or found.standard_error is None else f"± {_number(found.standard_error, metric)}"
    )


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
