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
from refine_proto.commands.cores import usable_cores
from refine_proto.commands.ending import BAD_INPUT, FAILED, fail

from .cases import Case, SetInvalid, read_bytes
from .coarse_files import FRAMES, CoarseFolder
from .methods import ABLATION, BASELINES, PLAIN, Method, ablation, make_method
from .records import Results
from .remote import server_method
from .report import write_report
from .rerender import rerender
from .runner import Plan, run
from .sets.folder import folder_cases
from .sets.odds import Odds
from .sets.pix3d import Pix3D
from .sets.shapenet import ShapeNet
from .sets.synthetic import LEVELS, synthetic_cases
from .show import Show
from .tables import tables_csv, tables_markdown

SERVER = "server"  # the name of the method behind --server
EPILOG = f"""\
methods (--method, several may be given)
  {PLAIN:22} the engine (the default)
  {", ".join(BASELINES)}
  {"":22} the vertices are optimised instead of a network, with the same losses
  module:function        your own refine(mesh, silhouette, camera) -> mesh
  --ablation             {", ".join(ABLATION)}

results, in --output
  tables.md tables.csv figure.png report.html results.jsonl pictures/
  The same command continues a run that was stopped, and tries again what failed.

examples
  refine bench synthetic --subset small --preset fast
  refine bench synthetic --ablation -o out/ablation
  refine bench shapenet ShapeNetRendering --models ShapeNetCore.v1 --coarse generation/meshes --frame unit_box
  refine bench synthetic --subset small --server http://localhost:8000 --in-flight 4
"""


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
    cases = [case for case in CASES[options.set](options) if _chosen(case, options)][: options.limit]
    if not cases:
        raise SetInvalid("expected at least one case, but the options leave none")
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


def _run(
    options: argparse.Namespace, cases: Sequence[Case], methods: Mapping[str, Method], folder: Path
) -> int:
    settings = {name: getattr(options, name) for name in ("set", "preset", "normalisation", "server")}
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


CASES: Mapping[str, Callable[[argparse.Namespace], list[Case]]] = {
    "synthetic": _synthetic,
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


def bench_parser() -> argparse.ArgumentParser:
    """The arguments of `refine bench`."""
    parser = argparse.ArgumentParser(
        prog="refine bench",
        description="Refine and score a data set: by how much do the meshes get better?",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    sets = parser.add_subparsers(dest="set", required=True, metavar="SET")
    common, files = _common_options(), _file_options()
    synthetic = sets.add_parser("synthetic", parents=[common], help="SyntheticShift: 60 objects made here")
    synthetic.add_argument("--subset", choices=["full", "small"], default="full", help="small: 12 of the 60")
    synthetic.add_argument("--level", action="append", choices=LEVELS, help="of domain shift (default: all)")
    synthetic.add_argument("--asymmetric", action="store_true", help="only the asymmetric objects")
    shapenet = sets.add_parser(
        "shapenet", parents=[common, files], help="ShapeNet with the 3D-R2N2 renderings, or re-rendered"
    )
    shapenet.add_argument("--models", type=Path, required=True, metavar="DIR", help="ShapeNetCore v1")
    shapenet.add_argument("--view", type=int, default=0, metavar="N", help="image of each model, 0 to 23 (0)")
    shapenet.add_argument("--instances", type=Path, metavar="FILE", help="a split: lines SYNSET/MODEL")
    shapenet.add_argument(
        "--asymmetric", action="store_true", help="ShapeNetAsym: only models whose symmetry loss is >= 0.01"
    )
    sets.add_parser("pix3d", parents=[common, files], help="Pix3D: the folder with pix3d.json")
    sets.add_parser("odds", parents=[common, files], help="3D-ODDS: OOWL and OWILD images")
    folder = sets.add_parser("folder", parents=[common], help="your own cases: one folder each")
    folder.add_argument(
        "path", type=Path, metavar="DIR", help="CASE/{coarse.obj,silhouette.png,camera.json,gt.obj}"
    )
    _add_rerender(sets)
    return parser


def _common_options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="results (out/bench-SET)")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="default")
    parser.add_argument("--method", action="append", metavar="NAME", help="see below; may be repeated")
    parser.add_argument("--ablation", action="store_true", help="the losses added group by group")
    parser.add_argument("--seeds", type=_positive, default=1, metavar="N", help="runs per case (1)")
    parser.add_argument("--case", action="append", metavar="TEXT", help="only cases whose name contains it")
    parser.add_argument("--limit", type=_positive, metavar="N", help="only the first N cases")
    parser.add_argument(
        "--normalisation", choices=["shared", "own"], default="shared",
        help="own: as the published evaluation of REFINE (shared)",
    )  # fmt: skip
    parser.add_argument(
        "--threads",
        type=_positive,
        default=usable_cores(),
        metavar="N",
        help="default: all cores (%(default)s)",
    )
    parser.add_argument("--server", metavar="URL", help="refine through a server: http(s)://, grpc(s)://")
    parser.add_argument("--in-flight", type=_positive, default=4, metavar="N", help="requests at once (4)")
    parser.add_argument("--api-key", metavar="KEY", help="of the server (default: $REFINE_API_KEY)")
    return parser


def _file_options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("path", type=Path, metavar="DIR", help="the set, as published")
    parser.add_argument(
        "--coarse", type=Path, required=True, metavar="DIR", help="a network's outputs, one mesh per instance"
    )
    parser.add_argument(
        "--frame", choices=FRAMES, default="world",
        help="of the coarse meshes: unit_box (OccNet), unit_ball (AtlasNet), pixel2mesh (world)",
    )  # fmt: skip
    parser.add_argument("--category", action="append", metavar="NAME", help="may be repeated (default: all)")
    return parser


def _add_rerender(sets: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = sets.add_parser("rerender", help="make RerenderedShapeNet from ShapeNet's models")
    parser.add_argument("models", type=Path, metavar="DIR", help="ShapeNetCore v1")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--views", type=_positive, default=1, metavar="N", help="images per model (1)")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    parser.add_argument("--limit", type=_positive, metavar="N", help="only the first N models")
    parser.set_defaults(threads=1)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number of at least 1, got {text!r}")
    return int(text)
