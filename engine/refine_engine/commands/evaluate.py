"""`refine eval`: how near a mesh is to ground truth, and what a refinement gained."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from refine_proto.commands.ending import BAD_INPUT, fail

if TYPE_CHECKING:
    from ..scores.scores import Scores
    from ..values import Mesh, View

DESCRIPTION = (
    "Compare a mesh with the ground truth in the same frame; with --coarse also show what was gained."
)
EPILOG = """\
metrics
  EMD              mean distance of the best one-to-one assignment of 2,048 points; two clouds of the same
                   surface score 0.03 to 0.1; first seed only
  Chamfer-l2       sum of both mean squared distances x 1000, 10,000 points per mesh
  F-score          per cent, at a distance of 0.05 (2.5 % of the longest side)
  volumetric IoU   by winding numbers, so that open meshes have one too; first seed only
  2D IoU           hard silhouette against the given one; needs --camera and --silhouette

normalisation
  shared           moved and scaled by the ground truth's box, longest side 2: a wrong size or place counts
  own              each mesh divided by half its own longest side, as the published evaluation of REFINE

example
  refine eval out/refined.glb gt.obj --coarse coarse.obj --camera camera.json --silhouette silhouette.png
"""
ROWS = {  # field of Scores: what the table calls it, digits, whether its change is in per cent
    "emd": ("EMD", 4, True),
    "chamfer_l2": ("Chamfer-l2", 2, True),
    "f_score": ("F-score", 1, False),
    "volumetric_iou": ("volumetric IoU", 3, False),
    "silhouette_iou": ("2D IoU", 3, False),
}


def eval_command(argv: Sequence[str]) -> int:
    """Run `refine eval` and return its exit code: 0 done, 2 bad input."""
    parser = eval_parser()
    arguments = parser.parse_args(argv)
    if (arguments.camera is None) != (arguments.silhouette is None):
        parser.error("expected --camera and --silhouette together: the 2D IoU needs both")
    from ..errors import InputError
    from ..scores.scores import evaluate

    try:
        view = None if arguments.camera is None else _read_view(arguments.camera, arguments.silhouette)
        ground_truth = _read_mesh(arguments.ground_truth)
        named = {"coarse": arguments.coarse, "predicted": arguments.predicted}
        meshes = {name: _read_mesh(path) for name, path in named.items() if path is not None}
        scores = {
            name: evaluate(
                mesh,
                ground_truth,
                normalisation=arguments.normalisation,
                seeds=range(arguments.seeds),
                view=view,
            )
            for name, mesh in meshes.items()
        }
        _draw(arguments, meshes, ground_truth, view)
    except (InputError, OSError) as error:
        return fail(str(error), BAD_INPUT)
    if arguments.json:
        result = {"normalisation": arguments.normalisation, "seeds": arguments.seeds}
        print(json.dumps(result | {name: asdict(row) for name, row in scores.items()}))
    else:
        print("\n".join(_table(scores)))
    return 0


def eval_parser() -> argparse.ArgumentParser:
    """The arguments of `refine eval`."""
    parser = argparse.ArgumentParser(
        prog="refine eval",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "predicted", type=Path, metavar="PREDICTED", help="the mesh to judge: GLB, glTF, OBJ, PLY, STL, OFF"
    )
    parser.add_argument(
        "ground_truth", type=Path, metavar="GROUND_TRUTH", help="the true mesh, in the same frame"
    )
    parser.add_argument(
        "--coarse", type=Path, metavar="MESH", help="the mesh before refinement, to compare with"
    )
    parser.add_argument("--camera", type=Path, metavar="JSON", help="camera of the silhouette (a CameraSpec)")
    parser.add_argument("--silhouette", type=Path, metavar="IMAGE", help="silhouette of the object")
    parser.add_argument(
        "--normalisation", choices=["shared", "own"], default="shared", help="default: shared"
    )
    parser.add_argument(
        "--seeds", type=_positive, default=5, metavar="N", help="random draws to average (default: 5)"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG",
        help="draw where it is wrong: the distance to the truth as colours, and from the truth to it",
    )  # fmt: skip
    parser.add_argument(
        "--turntable", type=Path, metavar="WEBP", help="draw the meshes and the truth, turning side by side"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def _draw(
    arguments: argparse.Namespace, meshes: dict[str, Mesh], ground_truth: Mesh, view: View | None
) -> None:
    """Write the pictures that were asked for."""
    if arguments.picture is not None:
        from ..artifacts.error_map import draw_errors

        arguments.picture.write_bytes(draw_errors(meshes, ground_truth, view))
    if arguments.turntable is not None:
        from ..artifacts.turntable import draw_turntable

        turning = draw_turntable(meshes | {"truth": ground_truth}, ground_truth)
        arguments.turntable.write_bytes(turning)


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number of at least 1, got {text!r}")
    return int(text)


def _read_mesh(path: Path) -> Mesh:
    from ..files.beside import in_folder_of
    from ..files.mesh_file import read_mesh

    return read_mesh(path.read_bytes(), path.name, beside=in_folder_of(path)).mesh


def _read_view(camera: Path, silhouette: Path) -> View:
    from ..cameras.spec import read_camera
    from ..request import read_view

    return read_view(silhouette.read_bytes(), read_camera(camera.read_bytes()))


def _table(scores: Mapping[str, Scores]) -> list[str]:
    """One line per metric; a distance changes in per cent of the coarse value, a score by a difference."""
    lines = [
        f"{'':16}" + "".join(f"{name:>12}" for name in scores) + ("      change" if len(scores) > 1 else "")
    ]
    columns = [asdict(row) for row in scores.values()]
    for field, (label, digits, relative) in ROWS.items():
        values = [column[field] for column in columns]
        if None in values:
            continue
        line = f"{label:16}" + "".join(f"{value:12.{digits}f}" for value in values)
        if len(values) > 1:
            change = values[-1] - values[0]
            line += f"{100 * change / values[0]:+10.1f} %" if relative else f"{change:+12.{digits}f}"
        lines.append(line)
    return lines
