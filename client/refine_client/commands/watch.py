"""`refine watch`: follow a refinement to its end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from refine_proto.commands.display import choose_display
from refine_proto.commands.ending import Parser
from refine_proto.models import Refinement

from ..client import RefineClient
from ..errors import error_of
from .server_command import command, connect, make_parser

EXAMPLE = """\
  refine watch ID
  refine watch ID -o out     after `refine submit` was stopped, or on another machine
  refine watch ID --json | jq -r 'select(.type == "progress") | .progress.percent'
"""


def watch_parser() -> Parser:
    """The arguments of `refine watch`."""
    parser = make_parser("watch", "Follow a refinement to its end; fails if it does.", EXAMPLE)
    parser.add_argument("id", metavar="ID")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="then download all artifacts")
    return parser


@command
def watch_command(argv: Sequence[str]) -> None:
    """Run `refine watch`."""
    arguments = watch_parser().parse_args(argv)
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)  # before the job's end, not after it
    with connect(arguments) as client:
        see_through(client, client.get(arguments.id), arguments.json, arguments.output)


def see_through(client: RefineClient, refinement: Refinement, as_json: bool, output: Path | None) -> None:
    """Show the refinement to its end, then fetch its artifacts; raises its error if it did not succeed."""
    display = choose_display(as_json)
    display.submitted(refinement)
    with display:
        for event in client.watch(refinement.id):
            display.event(event)
            refinement = event.refinement or refinement
    if error := error_of(refinement):
        raise error
    if not as_json:  # the last event has them
        for warning in refinement.warnings:
            display.warn(warning)
    display.finish(refinement)
    if output is not None:
        display.written(client.download(refinement.id, output))
