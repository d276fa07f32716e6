"""`refine check MESH SILHOUETTE --camera CAMERA.json`: what looks wrong, without a refinement."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from refine_proto.commands.ending import BAD_INPUT, Parser
from refine_proto.commands.options import add_options, read_options
from refine_proto.commands.validation import print_validation
from refine_proto.models import Validation

from ..cameras.seen import mean_silhouette_iou
from ..contract import config_of
from ..request import check_files
from .run import add_files, end, read_request


def check_command(argv: Sequence[str]) -> int:
    """0 if `refine run` would refine it, 2 if not; what looks wrong goes to standard output."""
    try:
        arguments = check_parser().parse_args(argv)
        validation = _check(arguments)
    except Exception as error:
        return end(error)
    print_validation(validation, arguments.json)
    return 0 if validation.accepted else BAD_INPUT


def check_parser() -> Parser:
    """The arguments of `refine check`."""
    parser = Parser(
        prog="refine check",
        description="Say what looks wrong with a mesh, its silhouette and its camera, in about a second.",
        epilog="`refine docs checks` explains what is checked, and what to do about it.",
    )
    add_files(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    add_options(parser)
    return parser


def _check(arguments: argparse.Namespace) -> Validation:
    options = read_options(arguments)
    inputs = read_request(arguments, options, config_of(options), check_files)
    iou = mean_silhouette_iou(inputs.mesh_file.mesh, inputs.views)
    return Validation.of(iou, inputs.warnings, inputs.findings)
