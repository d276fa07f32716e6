"""`refine run MESH SILHOUETTE --camera CAMERA.json -o DIR`: one refinement in this process."""

from __future__ import annotations

import argparse
import os
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch

from refine_proto import errors as contract
from refine_proto.camera_files import read_camera_file
from refine_proto.cameras import CameraSpec
from refine_proto.commands.cores import usable_cores
from refine_proto.commands.display import Display, choose_display
from refine_proto.commands.ending import BAD_INPUT, FAILED, Parser, fail
from refine_proto.commands.options import add_options, add_views, read_options, read_views
from refine_proto.models import Refinement, RefinementOptions

from ..artifacts.make import make_artifacts
from ..checks.check import GivenPlane
from ..contract import config_of
from ..errors import InputError, OptionsInvalid, RefineError
from ..files.beside import in_folder_of
from ..kernels.cuda import keep_float32
from ..method.config import RefineConfig
from ..request import Inputs, Observation, read_inputs
from .events import RunEvents


def run_command(argv: Sequence[str]) -> int:
    """0 done, 1 failed, 2 bad input; a failure is one line `error: REASON: message` on standard error."""
    try:
        _run(run_parser().parse_args(argv))
    except Exception as error:
        return end(error)
    return 0


def end(error: Exception) -> int:
    """Tell why a command ends; its exit code."""
    problem = told(error)
    code = BAD_INPUT if isinstance(problem, contract.InvalidInput) else FAILED
    return fail(f"{problem.reason}: {problem.detail}", code)


def told(error: Exception) -> contract.RefineError:
    """The error in the words of the contract."""
    match error:
        case contract.RefineError():
            return error
        case RefineError():
            return contract.error_class(error.reason)(str(error))
        case MemoryError() | torch.OutOfMemoryError():
            return contract.OutOfMemory(f"{error}; a mesh with fewer vertices needs less")
        case _:  # a bug of ours: say where, the user can report that
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(place.filename).name}:{place.lineno}"
            return contract.Internal(f"{type(error).__name__}: {error} ({where})")


def run_parser() -> Parser:
    """The arguments of `refine run`."""
    parser = Parser(
        prog="refine run",
        description="Refine a coarse mesh so that it agrees with its silhouette and stays plausible.",
        epilog="`refine docs conventions` explains cameras, silhouettes and units.",
    )
    add_files(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="for the artifacts")
    parser.add_argument(
        "--device", choices=["auto", "cpu", "cuda"], default="auto", help="auto: CUDA if present"
    )
    parser.add_argument(
        "--threads", type=int, default=usable_cores(), metavar="N", help="default: all cores (%(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object per line on standard output")
    add_options(parser)
    return parser


def add_files(parser: Parser) -> None:
    """The arguments that name the inputs of a run."""
    parser.add_argument(
        "mesh",
        type=Path,
        metavar="MESH",
        help="GLB, glTF, OBJ, PLY, STL, OFF, voxels (binvox, NPZ), or a ZIP",
    )
    add_views(parser)


def read_observations(arguments: argparse.Namespace) -> list[Observation]:
    """The views that the arguments of `add_files` name, at least one; raises InputError."""
    return [
        Observation(
            read_file(Path(paths.silhouette)),
            _camera(paths.camera, paths.place),
            read_file(Path(paths.ignore)) if paths.ignore else None,
        )
        for paths in read_views(arguments)
    ]


def read_request(
    arguments: argparse.Namespace,
    options: RefinementOptions,
    config: RefineConfig,
    read: Callable[..., Inputs],
) -> Inputs:
    """The files that the arguments of `add_files` name, by `read_inputs` or `check_files`; their errors."""
    first, *further = read_observations(arguments)
    return read(
        read_file(arguments.mesh),
        arguments.mesh.name,
        first.silhouette,
        first.camera,
        options.silhouette_threshold,
        beside=in_folder_of(arguments.mesh),
        ignore_grey=options.ignore_grey,
        ignore=first.ignore,
        more_views=further,
        checks=options.checks,
        symmetry=GivenPlane.of(config),
        subdivide=options.subdivide,
    )


def _run(arguments: argparse.Namespace) -> None:
    options = read_options(arguments)
    config = config_of(options)
    device = _device(arguments.device)
    if arguments.threads < 1:
        raise OptionsInvalid(f"expected at least one thread, got {arguments.threads}")
    torch.set_num_threads(arguments.threads)
    keep_float32()
    _check_target(arguments.output)
    inputs = read_request(arguments, options, config, read_inputs)
    display = choose_display(arguments.json)
    with display:
        events = RunEvents(arguments.mesh.name, options, display.event)
        try:
            refinement, artifacts = _refine(inputs, config, device, events, display)
        except Exception as error:
            events.failed(told(error))
            raise
    display.finish(refinement)
    display.written(_publish(artifacts, arguments.output))


def _refine(
    inputs: Inputs, config: RefineConfig, device: torch.device, events: RunEvents, display: Display
) -> tuple[Refinement, dict[str, bytes]]:
    events.read(inputs)
    for warning in inputs.warnings:  # now: they may be a reason to stop
        display.warn(warning)
    result = inputs.refine(config, device, events.report)
    for warning in result.warnings[len(inputs.warnings) :]:
        display.warn(warning)
    artifacts = make_artifacts(inputs, result, config)
    return events.succeeded(inputs, result, artifacts), artifacts


def _device(name: str) -> torch.device:
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise OptionsInvalid("expected a CUDA device for --device cuda, found none; use --device cpu")
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def read_file(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"expected a file that can be read, got {path}: {error.strerror}") from error


def _camera(path: Path, place: Sequence[str | int]) -> CameraSpec:
    try:
        return read_camera_file(path, place)
    except OSError as error:
        raise InputError(f"expected a file that can be read, got {path}: {error.strerror}") from error


def _check_target(target: Path) -> None:
    """Find out before the run, not after it, that the artifacts have no place to go."""
    existing = next(path for path in (target.absolute(), *target.absolute().parents) if path.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise OptionsInvalid(
            f"expected a folder to write to as --output, got {target}: {existing} is not one"
        )


def _publish(artifacts: Mapping[str, bytes], target: Path) -> dict[str, Path]:
    """Write all artifacts beside `target`, then move them there: whoever looks sees whole files only."""
    target.absolute().parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.absolute().parent, prefix=".refine-") as temporary:
        written = Path(temporary) / "artifacts"
        written.mkdir()
        for name, data in artifacts.items():
            (written / name).write_bytes(data)
        if target.exists():
            for name in artifacts:
                os.replace(written / name, target / name)
        else:
            written.rename(target)
    return {name: target / name for name in artifacts}
