"""`refine submit`: send a refinement; with --wait and -o, see it through."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from refine_proto.camera_files import read_camera_file
from refine_proto.commands.ending import Parser
from refine_proto.commands.options import add_options, add_views, read_options, read_views
from refine_proto.errors import InvalidInput
from refine_proto.models import MeshFormat, Priority, WebhookEvent

from ..upload import View, is_address
from .batch import run_batch
from .server_command import add_metadata, command, connect, make_parser, read_metadata
from .watch import see_through

EXAMPLE = """\
  refine submit coarse.glb silhouette.png --camera camera.json --wait -o out
  id=$(refine submit coarse.glb silhouette.png --camera camera.json) && refine watch "$id"
  refine submit --batch cases.jsonl -o out      many at once: refine submit --batch cases.jsonl --help

camera.json
  {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.9, "fov_y_degrees": 60}
  or another form, transforms.json#FRAME or COLMAP_FOLDER#IMAGE: refine docs conventions
"""


@command
def submit_command(argv: Sequence[str]) -> int | None:
    """Run `refine submit`."""
    if any(word.partition("=")[0] == "--batch" for word in argv):
        return run_batch(argv)
    arguments = submit_parser().parse_args(argv)
    first, *further = read_view_files(arguments)
    options = read_options(arguments)
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)  # before the job, not after it
    with connect(arguments) as client:
        refinement = client.submit(
            arguments.mesh,
            first.silhouette,
            first.camera,
            options,
            ignore=first.ignore,
            views=further,
            mesh_format=arguments.mesh_format,
            webhook=_webhook(arguments),
            metadata=read_metadata(arguments),
            idempotency_key=arguments.idempotency_key,
        )
        if not arguments.wait and arguments.output is None:
            print(refinement.model_dump_json(exclude_none=True) if arguments.json else refinement.id)
            return None
        try:
            see_through(client, refinement, arguments.json, arguments.output)
        except KeyboardInterrupt:
            again, stop = (
                f"refine watch {refinement.id}{_output(arguments)}",
                f"refine cancel {refinement.id}",
            )
            print(f"the refinement goes on; {again}, or {stop}", file=sys.stderr)
            raise
    return None


def _output(arguments: argparse.Namespace) -> str:
    return f" -o {shlex.quote(str(arguments.output))}" if arguments.output is not None else ""


def read_view_files(arguments: argparse.Namespace) -> list[View]:
    """The views that the arguments of `add_files` name; CameraInvalid."""
    return [
        View(paths.silhouette, read_camera_file(paths.camera, paths.place), paths.ignore)
        for paths in read_views(arguments)
    ]


def _webhook(arguments: argparse.Namespace) -> dict[str, object] | None:
    if arguments.webhook is None:
        if arguments.webhook_events:
            raise InvalidInput("expected --webhook URL with --webhook-event, got none")
        return None
    events = {"events": arguments.webhook_events} if arguments.webhook_events else {}
    return {"url": arguments.webhook, **events}


def submit_parser() -> Parser:
    """The arguments of `refine submit`."""
    parser = make_parser(
        "submit", "Send a mesh, its silhouette and the camera to a server and print the id.", EXAMPLE
    )
    add_files(parser)
    parser.add_argument("--wait", action="store_true", help="follow it to its end, with a progress bar")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="wait, then download all artifacts")
    parser.add_argument(
        "--idempotency-key", metavar="KEY", help="the same key and content give the same refinement"
    )
    add_metadata(parser, "to find it again")
    parser.add_argument("--webhook", metavar="URL", help="https address that is told of the end")
    parser.add_argument(
        "--webhook-event", dest="webhook_events", action="append", choices=list(WebhookEvent),
        metavar="EVENT",
        help=f"which ends it is told: {', '.join(WebhookEvent)}, as often as there are any (all)",
    )  # fmt: skip
    options = add_options(parser)
    options.add_argument("--timeout-s", type=float, metavar="S", help="longest running time (the server's)")
    options.add_argument(
        "--priority", choices=list(Priority), metavar="PRIORITY",
        help=f"{', '.join(Priority)}, as far as your key allows (normal)",
    )  # fmt: skip
    return parser


def _source(text: str) -> Path | str:
    return text if is_address(text) else Path(text)


def add_files(parser: Parser) -> None:
    """The arguments that name what is sent."""
    parser.add_argument(
        "mesh",
        type=_source,
        metavar="MESH",
        help="GLB, glTF, OBJ, PLY, STL, OFF, voxels (binvox, NPZ), or a ZIP; or its https address",
    )
    add_views(parser, _source)
    parser.add_argument(
        "--mesh-format", choices=list(MeshFormat), metavar="FORMAT", help="(the suffix of MESH)"
    )
