"""The tables as a picture: mean Chamfer-l2 per category before and after, and every case as a point."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib

matplotlib.use("Agg")  # files only: no window, no display needed

from matplotlib.figure import Figure

from .records import Record, without_seeds
from .tables import cell

BEFORE, AFTER = "#e07b39", "#2f5fb3"
LEVEL_COLOURS = ("#2f5fb3", "#e07b39", "#3a9a5b", "#8a4fb3")


def draw_figure(records: Sequence[Record], method: str) -> bytes:
    """PNG of one method, by 2D IoU where nothing has ground truth."""
    done = [r for r in without_seeds(records) if r.method == method]
    metric = "chamfer_l2" if cell(done, "chamfer_l2") else "silhouette_iou"
    label = "Chamfer-l2 (x 1000)" if metric == "chamfer_l2" else "2D IoU"
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    bars, points = figure.subplots(1, 2, width_ratios=(3, 2))
    categories = sorted({r.category for r in done})
    cells = [cell([r for r in done if r.category == category], metric) for category in categories]
    for offset, colour, name in ((-0.2, BEFORE, "before"), (0.2, AFTER, "after")):
        heights = [getattr(c, name) if c else 0.0 for c in cells]
        bars.bar([k + offset for k in range(len(cells))], heights, 0.4, color=colour, label=name)
    bars.set_xticks(range(len(categories)), categories, rotation=35, ha="right")
    bars.set_ylabel(f"mean {label}")
    bars.legend()
    for number, level in enumerate(sorted({r.level for r in done})):
        chosen = [
            (r.before[metric], r.after[metric]) for r in done if r.level == level and r.before and r.after
        ]
        if chosen:
            x, y = zip(*chosen, strict=True)
            points.scatter(x, y, 16, color=LEVEL_COLOURS[number % 4], label=level or "cases")
    ends = [value for axis in (points.get_xlim(), points.get_ylim()) for value in axis if value > 0]
    points.plot([min(ends), max(ends)], [min(ends), max(ends)], color="0.6", linewidth=1, zorder=0)
    if metric == "chamfer_l2":
        points.set_xscale("log")
        points.set_yscale("log")
    points.set_xlabel(f"{label} before")
    points.set_ylabel("after (on the line: unchanged)")
    points.legend()
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130)
    return stream.getvalue()
