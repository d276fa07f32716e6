"""`refine service`: the REST and gRPC service on a Redis that runs elsewhere."""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence

import redis.exceptions

from refine_jobs.logs import configure_logs
from refine_jobs.redis_server import check_server, connect
from refine_jobs.settings import OWNER_ONLY, JobSettings
from refine_proto.commands.ending import BAD_INPUT
from refine_proto.tracing import tracing

from ..server import run_service
from ..settings import ServiceSettings
from .arguments import add_listen_arguments, command, environment, make_parser

log = logging.getLogger(__name__)


def service_parser() -> argparse.ArgumentParser:
    """The arguments of `refine service`."""
    parser = make_parser(
        "service", "Run the REST and gRPC service. It needs REFINE_REDIS_URL; `refine serve` does not."
    )
    add_listen_arguments(parser)
    parser.add_argument(
        "--stop-with-stdin", action="store_true", help="stop when standard input closes, as if by SIGTERM"
    )
    return parser


@command
def service_command(argv: Sequence[str]) -> int:
    """Runs until SIGTERM or Ctrl-C; logs go to standard error, the addresses to standard output."""
    arguments = service_parser().parse_args(argv)
    os.umask(OWNER_ONLY)
    values = environment(arguments)
    jobs, settings = JobSettings.from_environment(values), ServiceSettings.from_environment(values)
    if jobs.redis_url is None:
        print("error: expected REFINE_REDIS_URL; `refine serve` brings its own Redis", file=sys.stderr)
        return BAD_INPUT
    configure_logs(lines_per_s=settings.log_lines_per_s)
    redis_url = jobs.redis_url.get_secret_value()
    try:
        with connect(redis_url) as server:
            check_server(server, jobs.sync_submissions)
    except (redis.exceptions.ConnectionError, redis.exceptions.TimeoutError) as error:
        log.warning("Redis does not answer yet: %s", error)

    def listening(rest: str, grpc: str) -> None:
        print(f"REST {rest} gRPC {grpc}", flush=True)
        if settings.key_required:
            log.info("every call needs an API key; `refine keys add OWNER` makes one")

    if arguments.stop_with_stdin:
        threading.Thread(target=_stop_at_end_of_stdin, daemon=True).start()
    with tracing("refine-service"):
        asyncio.run(run_service(settings, jobs, redis_url, listening))
    return 0


def _stop_at_end_of_stdin() -> None:
    """The parent holds the other end, so that this process ends with it, however it ends."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
