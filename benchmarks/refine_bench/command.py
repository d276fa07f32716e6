"""`refine bench SET`: refine and score a data set, and write tables, a figure and a report of every case."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from refine_engine.errors import RefineError
from refine_engine.method.presets import PRESETS
from refine_proto.commands.ending import BAD_INPUT, FAILED, fail

from .cases import Case, SetInvalid, read_bytes
from .coarse_files import CoarseFolder
from .export import export_case
from .families import FAMILIES
from .methods import PLAIN, ablation, make_method
from .options import bench_parser
from .outcome import Method
from .records import Results
from .remote import server_method
from .report import write_report
from .rerender import rerender
from .runner import Plan, run
from .sets.families import family_cases
from .sets.folder import folder_cases
from .sets.odds import Odds
from .sets.pix3d import Pix3D
from .sets.shapenet import ShapeNet
from .sets.synthetic import LEVELS, synthetic_cases
from .sets.upstream import upstream_cases
from .show import Show
from .tables import tables_csv, tables_markdown
from .upstream.photos import LEVELS as SHIFTS
from .variants import vary

SETTINGS = ("set", "set_seed", "preset", "normalisation", "server", "variant", "tell_plane")  # of one run
SERVER = "server"  # the name of the method behind --server


def bench_command(argv: Sequence[str]) -> int:
    """0 all cases done, 1 some failed, 2 the run could not start."""
    options = bench_parser().parse_args(argv)
    torch.set_num_threads(options.threads)
    try:
        if options.set == "rerender":
            return _rerender(options)
        return _bench(options)
    except RefineError as error:
        return fail(f"{error.reason}: {error}", BAD_INPUT)


def _bench(options: argparse.Namespace) -> int:
    chosen = [case for case in CASES[options.set](options) if _chosen(case, options)][: options.limit]
    cases = [_as_asked(case, options) for case in chosen]
    if not cases:
        raise SetInvalid("expected at least one case, but the options leave none")
    if options.write:
        return _write_cases(cases, options.write)
    folder = options.output or Path("out") / f"bench-{options.set}"
    if not options.server:
        config = PRESETS[options.preset]()
        names = ablation(config) if options.ablation else options.method or [PLAIN]
        return _run(options, cases, {name: make_method(name, config) for name in names}, folder)
    with server_method(options.server, options.preset, options.api_key) as server:
        code = _run(options, cases, {SERVER: server}, folder)
    summary = json.dumps(server.summary(), indent=2)
    (folder / "throughput.json").write_text(summary + "\n", encoding="utf-8")
    print(summary)
    return code


def _write_cases(cases: Sequence[Case], folder: Path) -> int:
    for case in cases:
        print(export_case(case, folder), flush=True)
    return 0


def _run(
    options: argparse.Namespace, cases: Sequence[Case], methods: Mapping[str, Method], folder: Path
) -> int:
    settings = {name: getattr(options, name, None) for name in SETTINGS}
    results = Results(folder, settings)
    plan = Plan(
        cases,
        methods,
        tuple(range(options.seeds)),
        options.normalisation,
        in_flight=options.in_flight if options.server else 1,
    )
    with Show() as show:
        run(plan, results, show)
    return _write(results, plan, options)


def _write(results: Results, plan: Plan, options: argparse.Namespace) -> int:
    """Tables, figure and report of all results in the folder; prints the tables."""
    records = results.records
    preset = (
        f"preset {options.preset}" if not options.server else f"{options.server}, preset {options.preset}"
    )
    title = f"refine bench {options.set}, {preset}"
    tables = tables_markdown(records, title)
    (results.folder / "tables.md").write_text(tables, encoding="utf-8")
    (results.folder / "tables.csv").write_text(tables_csv(records), encoding="utf-8")
    if any(record.status == "done" for record in records):
        _draw_figure(results, list(plan.methods))
    report = write_report(results.folder, records, title, tables)
    print(tables)
    print(f"{report}")
    return FAILED if any(record.status == "failed" for record in records) else 0


def _draw_figure(results: Results, methods: Sequence[str]) -> None:
    try:
        from .figure import draw_figure
    except ModuleNotFoundError as error:
        print(f"no figure: {error.name} is not installed; pip install 'refine-mesh[bench]'", file=sys.stderr)
        return
    (results.folder / "figure.png").write_bytes(draw_figure(results.records, methods))


def _chosen(case: Case, options: argparse.Namespace) -> bool:
    return options.case is None or any(part in case.name for part in options.case)


def _as_asked(case: Case, options: argparse.Namespace) -> Case:
    varied = vary(case, options.variant) if options.variant else case
    return replace(varied, plane_told=options.tell_plane)


def _coarse(options: argparse.Namespace) -> CoarseFolder:
    return CoarseFolder(options.coarse, options.frame)


def _shapenet(options: argparse.Namespace) -> list[Case]:
    instances: list[str] = []
    if options.instances:
        instances = read_bytes(options.instances).decode("utf-8", "replace").split()
    shapenet = ShapeNet(options.path, options.models, _coarse(options), options.view, options.category or ())
    return replace(shapenet, instances=instances, asymmetric=options.asymmetric).cases()


def _synthetic(options: argparse.Namespace) -> list[Case]:
    levels = options.level or LEVELS
    return [
        case
        for case in synthetic_cases(options.subset)
        if case.level in levels and (case.asymmetric or not options.asymmetric)
    ]


def _upstream(options: argparse.Namespace) -> list[Case]:
    levels = options.level or SHIFTS
    cases = upstream_cases(options.set_seed, options.count, options.network)
    return [case for case in cases if case.level in levels and (case.asymmetric or not options.asymmetric)]


def _families(options: argparse.Namespace) -> list[Case]:
    return [case for case in family_cases() if case.level in (options.level or FAMILIES)]


CASES: Mapping[str, Callable[[argparse.Namespace], list[Case]]] = {
    "synthetic": _synthetic,
    "upstream": _upstream,
    "families": _families,
    "shapenet": _shapenet,
    "pix3d": lambda options: Pix3D(options.path, _coarse(options), options.category or ()).cases(),
    "odds": lambda options: Odds(options.path, _coarse(options), options.category or ()).cases(),
    "folder": lambda options: folder_cases(options.path),
}


def _rerender(options: argparse.Namespace) -> int:
    problems = rerender(options.models, options.output, options.views, options.seed, options.limit)
    for problem in problems:
        print(f"not rendered: {problem}", file=sys.stderr)
    print(f"{options.output}: in the layout of the 3D-R2N2 renderings, for refine bench shapenet")
    return FAILED if problems else 0
