"""What a reader wants to know first: which cases got worse, and by how much the others got better."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from .cells import COLUMNS, arrow, cell, markdown, named
from .records import Record

SHOWN = ("chamfer_l2", "f_score", "silhouette_iou")
CLEARLY_WORSE = 1.05  # ratio of Chamfer-l2 after to before: below it the sampling of points has its share


def made_worse(records: Sequence[Record]) -> str:
    """The cases whose Chamfer-l2 grew, method after method, the worst first."""
    methods = list(dict.fromkeys(record.method for record in records))
    worse = [(value, record) for record in records if (value := ratio(record)) is not None and value > 1.0]
    if not worse:
        return "No case was made worse in Chamfer-l2."
    rows = [
        [named(record.method), record.case, f"x{value:.2f}", *_shown([record])]
        for value, record in sorted(worse, key=lambda pair: (methods.index(pair[1].method), -pair[0]))
    ]
    return markdown(["method", "case", "ratio", *_labels()], rows)


def summary(records: Sequence[Record]) -> str:
    """One line per method and level: ratios of Chamfer-l2, what got worse, gains."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        groups.setdefault((record.method, record.level), []).append(record)
    rows = [[named(method), level, *_line(group)] for (method, level), group in groups.items()]
    worse = ["n", "made worse", f"by more than {CLEARLY_WORSE - 1:.0%}", "worst ratio"]
    return markdown(["method", "level", *worse, "geometric mean ratio", *_labels(), "moved"], rows)


def confidence_table(records: Sequence[Record]) -> str | None:
    """Per method: mean confidence on symmetric objects, AUC on asymmetric ones; None if there is neither."""
    rows = []
    for method in dict.fromkeys(record.method for record in records):
        own = [record for record in records if record.method == method]
        means, areas = (_measured(own, name) for name in ("confidence_mean", "confidence_auc"))
        if means or areas:
            rows.append([named(method), *_mean_and_lowest(means), *_mean_and_lowest(areas)])
    header = ["method", "symmetric", "mean confidence", "lowest", "asymmetric", "AUC", "lowest"]
    return markdown(header, rows) if rows else None


def ratio(record: Record) -> float | None:
    """Chamfer-l2 after over before; None where it was not measured."""
    before, after = (record.before or {}).get("chamfer_l2"), (record.after or {}).get("chamfer_l2")
    return None if before is None or after is None else after / max(before, 1e-9)


def _line(records: Sequence[Record]) -> list[str]:
    ratios = {record.case: value for record in records if (value := ratio(record)) is not None}
    cells = [str(len(records)), "", "", "", ""]
    if ratios:
        worst = max(ratios, key=lambda case: ratios[case])
        cells[1:] = (
            *(f"{sum(value > limit for value in ratios.values())}" for limit in (1.0, CLEARLY_WORSE)),
            f"x{ratios[worst]:.2f} {worst}",
            f"x{statistics.geometric_mean(ratios.values()):.3f}",
        )
    moved = _measured(records, "motion")
    return [*cells, *_shown(records), f"{statistics.fmean(moved.values()):.2f} %" if moved else ""]


def _measured(records: Sequence[Record], name: str) -> dict[str, float]:
    """By case, where it was measured."""
    return {r.case: value for r in records if (value := r.measures.get(name)) is not None}


def _mean_and_lowest(values: dict[str, float]) -> list[str]:
    if not values:
        return ["0", "", ""]
    lowest = min(values, key=lambda case: values[case])
    return [str(len(values)), f"{statistics.fmean(values.values()):.3f}", f"{values[lowest]:.3f} {lowest}"]


def _labels() -> list[str]:
    return [COLUMNS[name].label for name in SHOWN]


def _shown(records: Sequence[Record]) -> list[str]:
    return [arrow(cell(records, name), name) for name in SHOWN]
