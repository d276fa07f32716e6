"""The paper's tables from the records of a run: what got worse, per category, and method against method.

A case is made worse when its Chamfer-l2 grew, or without ground truth when its 2D IoU fell.
"""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Iterable, Sequence

from .cells import COLUMNS, after, arrow, cell, markdown, median, named, number, standard_error
from .methods import ABLATION, ASYMMETRIC_ONLY
from .records import METRICS, Record, without_seeds
from .summary import confidence_table, made_worse, summary

NONE = "none"  # the coarse meshes, as a row beside the methods


def tables_markdown(records: Sequence[Record], title: str) -> str:
    """Everything that a run measured, as one document."""
    averaged = without_seeds(records)
    parts = [f"# {title}", _legend(records)]
    methods = _in_order(r.method for r in averaged)
    levels = _in_order(r.level for r in averaged)
    parts += ["## Made worse", made_worse(averaged), "## Summary", summary(averaged)]
    if confidence := confidence_table(averaged):
        parts += ["## Confidence of symmetry", confidence]
    if len(methods) > 1:
        parts += _comparisons(averaged, methods, levels)
    for method in methods:
        own = [r for r in averaged if r.method == method]
        parts += [f"## {named(method)}", by_category(own)]
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
        [category, str(len(chosen)), *(arrow(cell(chosen, name), name) for name in metrics)]
        for (category,), chosen in _by(records, "category")
    ]
    total = {name: cell(records, name) for name in metrics}
    rows.append(["**mean**", str(len(records)), *(f"**{arrow(total[name], name)}**" for name in metrics)])
    rows.append(["median", "", *(median(total[name], name) for name in metrics)])
    rows.append(["standard error", "", *(standard_error(total[name], name) for name in metrics)])
    rows.append(["made worse", "", *(f"{c.worse} of {c.cases}" for c in total.values() if c is not None)])
    return markdown(["category", "n", *(COLUMNS[name].label for name in metrics)], rows)


def comparison(records: Sequence[Record], methods: Sequence[str]) -> str:
    """Method x metric: the means over the cases that all the methods did, so that they compare."""
    sets = [{r.case for r in records if r.method == method} for method in methods]
    common = set.intersection(*sets)
    chosen = [r for r in records if r.case in common]
    metrics = [name for name in METRICS if cell(chosen, name) is not None]
    first = [r for r in chosen if r.method == methods[0]]
    rows = [[NONE, *(number(c.before, name) for name in metrics if (c := cell(first, name))), ""]]
    for method in methods:
        own = [r for r in chosen if r.method == method]
        cells = {name: cell(own, name) for name in metrics}
        rows.append([named(method), *(after(cells[name], name) for name in metrics), _worse(own)])
    return markdown([f"method (n = {len(common)})", *(COLUMNS[m].label for m in metrics), "made worse"], rows)


def seed_spread(records: Sequence[Record]) -> str:
    """Per method the mean over cases for each seed: its mean over the seeds, and their standard deviation."""
    rows = []
    done = [r for r in records if r.status == "done"]
    for (method,), own in _by(done, "method"):
        seeds = [chosen for _, chosen in _by(own, "seed")]
        row = [named(method), str(len(seeds))]
        for name in METRICS:
            means = [c.after for chosen in seeds if (c := cell(chosen, name))]
            spread = statistics.stdev(means) if len(means) > 1 else 0.0
            row.append(f"{number(statistics.fmean(means), name)} ± {number(spread, name)}" if means else "")
        rows.append(row)
    return markdown(["method", "seeds", *(COLUMNS[name].label for name in METRICS)], rows)


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
    lines = [f"- {r.case} ({named(r.method)}): {r.status}: {r.message}" for r in problems]
    return ["## Not measured", "\n".join(lines)]


def _worse(records: Sequence[Record]) -> str:
    found = cell(records, "chamfer_l2") or cell(records, "silhouette_iou")
    return "" if found is None else f"{found.worse} of {found.cases}"


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
