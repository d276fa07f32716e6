"""`refine camera MESH SILHOUETTE`: estimate the camera that saw a silhouette."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from refine_proto.cameras import EstimatedCamera
from refine_proto.checks import Checks
from refine_proto.commands.ending import Parser
from refine_proto.commands.estimate import print_estimate
from refine_proto.errors import from_validation
from refine_proto.models import CameraEstimate

from ..contract import estimate_of
from ..errors import InputError
from ..files.beside import in_folder_of
from ..request import check_files
from .run import end, read_file

KNOWN = ("fov_y_degrees", "fov_x_degrees", "azimuth_degrees", "elevation_degrees", "roll_degrees")


def camera_command(argv: Sequence[str]) -> int:
    """0 estimated, 2 bad input; the camera and its alternatives go to standard output."""
    try:
        arguments = camera_parser().parse_args(argv)
        estimate = _estimate(arguments)
        if arguments.output is not None:
            _write(arguments.output, estimate)
    except Exception as error:
        return end(error)
    print_estimate(estimate, arguments.json)
    return 0


def camera_parser() -> Parser:
    """The arguments of `refine camera`."""
    parser = Parser(
        prog="refine camera",
        description="Estimate the camera that saw a silhouette, in a few seconds.",
        epilog="`refine docs cameras` says how often it is right.",
    )
    parser.add_argument("mesh", type=Path, metavar="MESH", help="GLB, glTF, OBJ, PLY, STL, OFF, or a ZIP")
    parser.add_argument(
        "silhouette", type=Path, metavar="SILHOUETTE",
        help="PNG, JPEG, WebP, TIFF or BMP: alpha, or white on black",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, metavar="CAMERA.json", help="write the camera there")
    parser.add_argument("--fov-y-degrees", type=float, metavar="D", help="if it is known (45, and improved)")
    parser.add_argument("--fov-x-degrees", type=float, metavar="D", help="the same of the width")
    parser.add_argument("--azimuth-degrees", type=float, metavar="D", help="roughly, within 45 (any)")
    parser.add_argument("--elevation-degrees", type=float, metavar="D", help="roughly, within 30 (any)")
    parser.add_argument("--roll-degrees", type=float, metavar="D", help="exactly (0)")
    parser.add_argument(
        "--ignore", type=Path, metavar="IMAGE", help="where it shows an object, nothing is known (none)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    return parser


def _estimate(arguments: argparse.Namespace) -> CameraEstimate:
    given = {name: getattr(arguments, name) for name in KNOWN if getattr(arguments, name) is not None}
    try:
        camera = EstimatedCamera.model_validate(given)
    except ValidationError as error:
        raise from_validation(error.errors(), under=("camera",)) from None
    inputs = check_files(
        read_file(arguments.mesh),
        arguments.mesh.name,
        read_file(arguments.silhouette),
        camera,
        beside=in_folder_of(arguments.mesh),
        ignore=read_file(arguments.ignore) if arguments.ignore else None,
        checks=Checks.OFF,
    )
    return estimate_of(inputs.estimate)


def _write(path: Path, estimate: CameraEstimate) -> None:
    try:
        path.write_text(estimate.camera.model_dump_json(exclude_none=True) + "\n")
    except OSError as error:
        raise InputError(f"expected a file that can be written, got {path}: {error.strerror}") from error
