"""report.html: every result with its pictures and loss curve, the worst first, in one file."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path

from .cells import COLUMNS
from .methods import TITLES
from .pictures import COLUMNS as PANELS
from .records import Record

PLOT_WIDTH, PLOT_HEIGHT = 220, 90  # pixels of a loss curve
STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1180px; padding: 0 1rem;
       color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.05rem; margin: 0 }
.case { border: 1px solid #ddd; border-radius: 6px; padding: .8rem 1rem; margin: 1rem 0; display: grid;
        grid-template-columns: minmax(0, 840px) 1fr; gap: 0 1.2rem }
.case header { grid-column: 1 / -1; display: flex; gap: .8rem; align-items: baseline; flex-wrap: wrap }
.tag { color: #666 } .worse { color: #b3261e } .better { color: #1b6e3c }
.panels { display: grid; grid-template-columns: repeat(6, 1fr); color: #666; text-align: center;
          margin-top: .4rem }
img { width: 100%; display: block; background: #fff }
table { border-collapse: collapse; margin: .4rem 0 }
td, th { padding: .1rem .5rem .1rem 0; text-align: right }
td:first-child, th:first-child { text-align: left } th { font-weight: 600; color: #666 }
pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: 12px }
svg { display: block; margin-top: .5rem } .note { color: #666 }
@media (max-width: 900px) { .case { grid-template-columns: 1fr } }
"""
LEGEND = (
    "Above as the input camera sees it, below from a quarter turn around the object. Under the input: its "
    "silhouette against the refined mesh, grey where they agree, blue what the mesh misses, orange what it "
    "has too much. Confidence of symmetry: dark low, bright high. "
    "Error: the refined mesh's distance to the truth, dark none, bright 5 % of its longest side and more."
)


def write_report(folder: Path, records: Sequence[Record], title: str, tables: str) -> Path:
    """Write report.html into the results folder and return its path."""
    done = sorted((r for r in records if r.status == "done"), key=badness, reverse=True)
    problems = [r for r in records if r.status != "done"]
    figure = folder / "figure.png"
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{html.escape(title)}</title><style>{STYLE}</style><h1>{html.escape(title)}</h1>",
        f"<details><summary>Figure</summary><img alt='before and after' src='{_inline(figure)}'></details>"
        if figure.exists()
        else "",
        f"<details><summary>Tables</summary><pre>{html.escape(tables)}</pre></details>",
        f"<p class='note'>{len(done)} results, the worst first. {LEGEND}</p>",
        *(_case(folder, record) for record in done),
        "<h2>Not measured</h2>" if problems else "",
        *(f"<p>{html.escape(f'{r.case} ({r.method}): {r.status}: {r.message}')}</p>" for r in problems),
    ]
    path = folder / "report.html"
    path.write_text("\n".join(parts) + "</html>\n", encoding="utf-8")
    return path


def badness(record: Record) -> float:
    """Chamfer-l2 after as a share of before; without ground truth what the 2D IoU lacks, likewise."""
    before, after = record.before or {}, record.after or {}
    if (first := before.get("chamfer_l2")) is not None and (last := after.get("chamfer_l2")) is not None:
        return last / max(first, 1e-9)
    if (seen := before.get("silhouette_iou")) is not None and (
        now := after.get("silhouette_iou")
    ) is not None:
        return (1 - now) / max(1 - seen, 1e-9)
    return 0.0


def _case(folder: Path, record: Record) -> str:
    ratio = badness(record)
    kind = "worse" if ratio > 1 else "better"
    tags = [record.category, record.level, "asymmetric" if record.asymmetric else "", _method(record)]
    timing = f"{record.seconds:.1f} s" + (
        "" if record.queue_s is None else f", {record.queue_s:.1f} s queued"
    )
    picture = folder / record.picture if record.picture else None
    panels = "".join(f"<span>{name}</span>" for name in PANELS)
    image = f"<img alt='{html.escape(record.case)}' src='{_inline(picture)}'>" if picture else ""
    return (
        f"<section class='case'><header><h2>{html.escape(record.case)}</h2>"
        f"<span class='{kind}'>error x {ratio:.2f}</span>"
        f"<span class='tag'>{html.escape(' · '.join(tag for tag in tags if tag))} · {timing}</span></header>"
        f"<div><div class='panels'>{panels}</div>{image}</div>"
        f"<div>{_scores(record)}{_curve(record.loss_curve)}</div></section>"
    )


def _method(record: Record) -> str:
    return f"{TITLES.get(record.method, record.method)}, seed {record.seed}"


def _scores(record: Record) -> str:
    rows = []
    for name, column in COLUMNS.items():
        before, after = (record.before or {}).get(name), (record.after or {}).get(name)
        if before is not None and after is not None:
            better = (after < before) == column.smaller_is_better or after == before
            kind = "better" if better else "worse"
            numbers = f"<td>{before:.{column.digits}f}</td><td class='{kind}'>{after:.{column.digits}f}</td>"
            rows.append(f"<tr><td>{column.label}</td>{numbers}</tr>")
    return f"<table><tr><th></th><th>before</th><th>after</th></tr>{''.join(rows)}</table>"


def _curve(losses: Sequence[float]) -> str:
    """The total loss over the iterations as an SVG line."""
    if len(losses) < 2:
        return "<p class='note'>no loss curve</p>"
    low, high = min(losses), max(losses)
    span = max(high - low, 1e-12)
    points = " ".join(
        f"{k * PLOT_WIDTH / (len(losses) - 1):.1f},{(high - value) / span * PLOT_HEIGHT:.1f}"
        for k, value in enumerate(losses)
    )
    return (
        f"<svg width='{PLOT_WIDTH}' height='{PLOT_HEIGHT + 18}' role='img' aria-label='loss curve'>"
        f"<polyline points='{points}' fill='none' stroke='#2f5fb3' stroke-width='1.5'/>"
        f"<text x='0' y='{PLOT_HEIGHT + 14}' font-size='11' fill='#666'>"
        f"loss {losses[0]:.3g} to {losses[-1]:.3g}</text></svg>"
    )


def _inline(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
