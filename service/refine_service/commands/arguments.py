"""Arguments that are settings, and how a command ends whose settings cannot be used."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps

from pydantic import ValidationError

from refine_jobs.embedded import EmbeddedRedisError
from refine_jobs.redis_server import RedisUnfit
from refine_proto.commands.ending import BAD_INPUT

from ..edge.auth import KeysFileInvalid


def make_parser(command: str, description: str) -> argparse.ArgumentParser:
    """With the arguments that say where data is."""
    parser = argparse.ArgumentParser(
        prog=f"refine {command}",
        description=description,
        epilog="--data-folder is also REFINE_DATA_FOLDER, and so on; every setting: refine docs operating",
    )
    parser.add_argument("--data-folder", metavar="DIR", help="for the embedded Redis, blobs and API keys")
    return parser


def add_listen_arguments(parser: argparse.ArgumentParser) -> None:
    """--host and the two ports."""
    parser.add_argument("--host", help="address to listen on (127.0.0.1)")
    parser.add_argument("--http-port", metavar="PORT", help="for REST (8000); 0: any free one")
    parser.add_argument("--grpc-port", metavar="PORT", help="for gRPC (50051); 0: any free one")


def environment(arguments: argparse.Namespace) -> dict[str, str]:
    """The environment with the given arguments in the place of their variables."""
    given = {f"REFINE_{name.upper()}": value for name, value in vars(arguments).items()}
    return {**os.environ, **{name: value for name, value in given.items() if isinstance(value, str)}}


def command(run: Callable[[Sequence[str]], int]) -> Callable[[Sequence[str]], int]:
    """Tell what cannot be read or started in one line, with exit code 2."""

    @wraps(run)
    def with_exit_code(argv: Sequence[str]) -> int:
        try:
            return run(argv)
        except ValidationError as error:
            for line in error.errors():
                if line["loc"]:
                    name = "_".join(str(step) for step in line["loc"]).upper()
                    print(f"error: REFINE_{name}: {line['msg']}, got {line['input']!r}", file=sys.stderr)
                else:  # of several settings together
                    print(f"error: {line['msg'].removeprefix('Value error, ')}", file=sys.stderr)
        except (OSError, RedisUnfit, EmbeddedRedisError, KeysFileInvalid) as error:
            print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT

    return with_exit_code
