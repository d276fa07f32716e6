"""The tables as a picture: mean Chamfer-l2 per category before and after, and every case as a point."""

from __future__ import annotations

import io
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure  # without pyplot: files only, no window, no display needed

from .cells import cell
from .methods import TITLES
from .records import Record, without_seeds

BEFORE, AFTER = "#e07b39", "#2f5fb3"
LABELS = {"chamfer_l2": "Chamfer-l2 (x 1000)", "silhouette_iou": "2D IoU"}
LEVEL_COLOURS = ("#2f5fb3", "#e07b39", "#3a9a5b", "#8a4fb3")


def draw_figure(records: Sequence[Record], methods: Sequence[str]) -> bytes:
    """PNG with a row per method, by 2D IoU where nothing has ground truth."""
    done = without_seeds(records)
    metric = "chamfer_l2" if cell(done, "chamfer_l2") else "silhouette_iou"
    shown = [method for method in methods if any(r.method == method for r in done)]
    figure = Figure(figsize=(11, 4.2 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), 2, width_ratios=(3, 2), squeeze=False)
    for (bars, points), method in zip(axes, shown, strict=True):
        chosen = [r for r in done if r.method == method]
        _draw_bars(bars, chosen, metric)
        _draw_points(points, chosen, metric)
        bars.set_title(TITLES.get(method, method), loc="left")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()


def _draw_bars(axes: Axes, records: Sequence[Record], metric: str) -> None:
    categories = sorted({r.category for r in records})
    cells = [cell([r for r in records if r.category == category], metric) for category in categories]
    for offset, colour, name in ((-0.2, BEFORE, "before"), (0.2, AFTER, "after")):
        heights = [getattr(c, name) if c else 0.0 for c in cells]
        axes.bar([k + offset for k in range(len(cells))], heights, 0.4, color=colour, label=name)
    axes.set_xticks(range(len(categories)), categories, rotation=35, ha="right")
    axes.set_ylabel(f"mean {LABELS[metric]}")
    axes.legend()


def _draw_points(axes: Axes, records: Sequence[Record], metric: str) -> None:
    for number, level in enumerate(sorted({r.level for r in records})):
        pairs = [
            (r.before[metric], r.after[metric]) for r in records if r.level == level and r.before and r.after
        ]
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        if known:
            colour = LEVEL_COLOURS[number % len(LEVEL_COLOURS)]
            x, y = zip(*known, strict=True)
            axes.scatter(x, y, 16, color=colour, label=level or "cases")
    if metric == "chamfer_l2":
        axes.set_xscale("log")
        axes.set_yscale("log")
    low, high = (f(*axes.get_xlim(), *axes.get_ylim()) for f in (min, max))
    axes.plot([low, high], [low, high], color="0.6", linewidth=1, zorder=0)
    axes.set_xlabel(f"{LABELS[metric]} before")
    axes.set_ylabel("after (on the line: unchanged)")
    axes.legend()
