"""The command `refine`: finds the subcommand's implementation and hands it the rest of the command line.

Implementations are entry points of the group `refine.commands`: functions `(argv: Sequence[str]) -> int`
whose result is the exit code: 0 done, 1 failed, 2 bad input. Only the one asked for is imported, so
`refine --help` needs neither torch nor numpy.
"""

import difflib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import NamedTuple

DISTRIBUTION = "refine-mesh"
INTERRUPTED = 130  # what a shell reports for a process that ended on Ctrl-C


class Command(NamedTuple):
    help: str
    extras: tuple[str, ...] = ()  # of the distribution, that bring it; none: the base install


COMMANDS = {
    "run": Command("refine one mesh in this process", ("engine",)),
    "check": Command("say what looks wrong with a mesh, its silhouette and its camera", ("engine",)),
    "camera": Command("estimate the camera that saw a silhouette", ("engine",)),
    "eval": Command("compare a mesh with the ground truth: EMD, Chamfer-l2, F-score, IoU", ("engine",)),
    "bench": Command("refine and score a whole data set", ("bench",)),
    "serve": Command("run everything here: Redis, service and worker", ("service", "worker")),
    "service": Command("run the REST and gRPC service", ("service",)),
    "keys": Command("create and revoke API keys", ("service",)),
    "worker": Command("run worker slots", ("worker",)),
    "submit": Command("send a mesh, a silhouette and a camera to a server"),
    "validate": Command("let a server say what looks wrong with a mesh, its silhouette and its camera"),
    "get": Command("show one refinement"),
    "list": Command("list refinements"),
    "watch": Command("follow the progress of a refinement"),
    "extend": Command("keep a refinement for longer"),
    "cancel": Command("cancel a refinement"),
    "delete": Command("remove a refinement and its files"),
    "download": Command("fetch the artifacts of a refinement"),
    "docs": Command("print a page of the documentation"),
    "completion": Command("let the shell complete commands and options"),
}
# What tells that an extra is installed: found without being imported, before a command starts anything.
MODULES_OF_EXTRA = {
    "bench": ("torch", "manifold3d"),
    "engine": ("torch",),
    "service": ("fastapi",),
    "worker": ("torch", "rq"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one subcommand and returns the exit code; a KeyboardInterrupt becomes 130 without a traceback."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["help"] and len(arguments) > 1:
        arguments = [*arguments[1:], "--help"]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0 if arguments else 2
    if arguments[0] in ("-V", "--version"):
        print(f"refine {metadata.version(DISTRIBUTION)}")
        return 0
    try:
        return _run(arguments[0], arguments[1:])
    except _NotRunnable as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


class _NotRunnable(Exception):
    """The command does not exist, or what it needs is not installed."""


def _run(name: str, argv: Sequence[str]) -> int:
    if name not in COMMANDS:
        begun = [command for command in COMMANDS if name.startswith(command)]
        near = begun or difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else "refine --help lists them"
        raise _NotRunnable(f"expected a command of refine, got {name!r}; {hint}")
    entry_point = installed_commands().get(name)
    if entry_point is None:
        raise _NotRunnable(
            f"refine {name} is not part of this installation of {DISTRIBUTION}; install it again"
        )
    for module in (module for extra in COMMANDS[name].extras for module in MODULES_OF_EXTRA[extra]):
        if not _is_installed(module):
            raise _NotRunnable(_needs(name, module))
    try:
        command: Callable[[Sequence[str]], int] = entry_point.load()
        return command(argv)
    except ModuleNotFoundError as error:  # some commands import what they need when they run
        raise _NotRunnable(_needs(name, error.name)) from error


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ImportError:  # from what hides modules
        return False


def _needs(name: str, module: str | None) -> str:
    # pip finds the distribution installed and adds the extra to it, wherever it came from.
    extras = ",".join(COMMANDS[name].extras)
    wanted = f"{DISTRIBUTION}[{extras}]" if extras else DISTRIBUTION
    return f"refine {name} needs {module}, which is not installed; pip install '{wanted}'"


def installed_commands() -> dict[str, metadata.EntryPoint]:
    """The entry points of the installation, by the name of their command."""
    return {entry_point.name: entry_point for entry_point in metadata.entry_points(group="refine.commands")}


def _help() -> str:
    installed = installed_commands()
    rows = [f"  {name:<12}{command.help}" for name, command in COMMANDS.items() if name in installed]
    return "\n".join(
        [
            "usage: refine COMMAND [ARGUMENTS]",
            "",
            "Refines a coarse mesh at test time from its silhouette and camera.",
            "",
            *rows,
            "",
            "refine help COMMAND explains a command, refine docs the whole; refine --version is the version.",
        ]
    )
