"""What the commands that call a server share: their arguments, the connection, and how an error ends one."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import wraps

from refine_proto.commands.ending import BAD_INPUT, FAILED, Parser, fail
from refine_proto.errors import InvalidInput, RefineError, Refused
from refine_proto.lists import read_pairs

from ..address import DEFAULT_SERVER
from ..client import RefineClient

SERVER_HELP = f"""\
server
  --server URL, else the variable REFINE_SERVER, else {DEFAULT_SERVER}
  http://host:8000 or https://host speaks REST, grpc://host:50051 or grpcs://host:443 speaks gRPC
  the variable REFINE_API_KEY signs in
exit codes: 0 done, 1 the job or the server failed, 2 bad input
"""


def make_parser(command: str, description: str, example: str) -> Parser:
    """With --server, --json and a help that ends in examples."""
    parser = Parser(
        prog=f"refine {command}",
        description=description,
        epilog=f"{SERVER_HELP}\nexample\n{example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--server", metavar="URL", help="where the service is, see below")
    parser.add_argument("--json", action="store_true", help="print JSON for programs, one object per line")
    return parser


def add_metadata(parser: Parser, purpose: str) -> None:
    """--metadata, as often as there are pairs."""
    parser.add_argument(
        "--metadata", action="append", default=[], metavar="KEY=VALUE", help=f"{purpose}, any number of them"
    )


def read_metadata(arguments: argparse.Namespace) -> dict[str, str]:
    """The pairs that the arguments say; InvalidInput."""
    return read_pairs(arguments.metadata)


def connect(arguments: argparse.Namespace) -> RefineClient:
    return RefineClient(arguments.server)


def command(
    run: Callable[[Sequence[str]], int | None],
) -> Callable[[Sequence[str]], int]:
    """Make an exit code of how `run` ends, if it gives none.

    An error is one line `error: REASON: detail (request ID)`.
    """

    @wraps(run)
    def with_exit_code(argv: Sequence[str]) -> int:
        try:
            return run(argv) or 0
        except RefineError as error:
            request = f" (request {error.request_id})" if error.request_id else ""
            code = BAD_INPUT if isinstance(error, (InvalidInput, Refused)) else FAILED
            return fail(f"{error.reason}: {error.detail}{request}", code)
        except TimeoutError as error:
            return fail(f"TIMEOUT: {error}", FAILED)
        except OSError as error:
            name = f"{error.filename}: " if error.filename else ""
            return fail(f"INPUT_INVALID: {name}{error.strerror or error}", BAD_INPUT)

    return with_exit_code
