"""The arguments of `refine bench`."""

from __future__ import annotations

import argparse
from pathlib import Path

from refine_engine.method.presets import PRESETS
from refine_proto.commands.cores import usable_cores

from .coarse_files import FRAMES
from .families import FAMILIES
from .methods import ABLATION, BASELINES, PLAIN, WHITE_BOX
from .sets.synthetic import LEVELS
from .upstream.network import KINDS as NETWORKS
from .upstream.photos import LEVELS as SHIFTS
from .variants import VARIANTS

EPILOG = f"""\
methods (--method, several may be given)
  {PLAIN:22} the engine (the default)
  {", ".join(PRESETS)}
  {"":22} the engine with that preset, whatever --preset says: to have several in one table
  {", ".join(BASELINES)}
  {"":22} the vertices are optimised instead of a network, with the same losses
  {WHITE_BOX:22} the network's latent code is fine-tuned instead of the mesh; upstream only
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
    upstream = sets.add_parser(
        "upstream", parents=[common], help="objects made here, as our own network reconstructs them"
    )
    upstream.add_argument("--level", action="append", choices=SHIFTS, help="of domain shift (default: all)")
    upstream.add_argument(
        "--network",
        choices=NETWORKS,
        default="image",
        help="what it knows: the image alone (default), or the camera too",
    )
    upstream.add_argument("--set-seed", type=int, default=0, metavar="N", help="names the set (0)")
    upstream.add_argument("--count", type=_positive, default=26, metavar="N", help="cases per level (26)")
    upstream.add_argument("--asymmetric", action="store_true", help="only the asymmetric objects")
    families = sets.add_parser(
        "families", parents=[common], help="SyntheticShift's objects as AtlasNet, Mesh R-CNN, DISN shape them"
    )
    families.add_argument("--level", action="append", choices=tuple(FAMILIES), help="family (default: all)")
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
    parser.add_argument(
        "--variant", choices=tuple(VARIANTS),
        help="turned, small in a photo, noisy camera and mask; truth: the true mesh as the coarse one",
    )  # fmt: skip
    parser.add_argument("--tell-plane", action="store_true", help="tell the method the true mirror plane")
    parser.add_argument("--ablation", action="store_true", help="the losses added group by group")
    parser.add_argument("--seeds", type=_positive, default=1, metavar="N", help="runs per case (1)")
    parser.add_argument("--case", action="append", metavar="TEXT", help="only cases whose name contains it")
    parser.add_argument("--limit", type=_positive, metavar="N", help="only the first N cases")
    parser.add_argument(
        "--write",
        type=Path,
        metavar="DIR",
        help="write the cases as folders for `refine bench folder`; no run",
    )
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
