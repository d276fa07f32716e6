"""`refine validate`: let a server say what looks wrong, without a refinement."""

from __future__ import annotations

from collections.abc import Sequence

from refine_proto.commands.ending import BAD_INPUT, Parser
from refine_proto.commands.options import add_options, read_options
from refine_proto.commands.validation import print_validation

from .server_command import command, connect, make_parser
from .submit import add_files, read_view_files

EXAMPLE = """\
  refine validate coarse.glb silhouette.png --camera camera.json
  refine check does the same without a server; refine docs checks explains what is found
"""


@command
def validate_command(argv: Sequence[str]) -> int:
    """0 if the server would refine it, 2 if not; what looks wrong goes to standard output."""
    arguments = validate_parser().parse_args(argv)
    first, *further = read_view_files(arguments)
    options = read_options(arguments)
    with connect(arguments) as client:
        validation = client.validate(
            arguments.mesh,
            first.silhouette,
            first.camera,
            options,
            ignore=first.ignore,
            views=further,
            mesh_format=arguments.mesh_format,
        )
    print_validation(validation, arguments.json)
    return 0 if validation.accepted else BAD_INPUT


def validate_parser() -> Parser:
    """The arguments of `refine validate`."""
    parser = make_parser(
        "validate", "Let a server say what looks wrong with a mesh, its silhouette and its camera.", EXAMPLE
    )
    add_files(parser)
    add_options(parser)
    return parser
