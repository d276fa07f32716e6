"""`refine worker`: runs the worker, or asks the one that runs on this machine how it is."""

from __future__ import annotations

import argparse
import os
import sys
import urllib.error
import urllib.request
from collections.abc import Sequence

from refine_proto.commands.ending import BAD_INPUT, FAILED

from .port import PROBES

_ANSWER_S = 5.0


def worker_parser() -> argparse.ArgumentParser:
    """The arguments of `refine worker`."""
    parser = argparse.ArgumentParser(
        prog="refine worker",
        description="Run worker slots: they take jobs from the queue and refine them.",
        epilog="Settings are variables (REFINE_REDIS_URL, REFINE_DEVICES, ...): refine docs worker",
    )
    parser.add_argument(
        "--stop-with-stdin", action="store_true", help="stop when standard input closes, as if by SIGTERM"
    )
    parser.add_argument(
        "--check",
        choices=PROBES,
        help="ask the worker that runs on this machine with the same REFINE_WORKER_PORT: exit code 0 if it "
        "is so, else 1",
    )
    return parser


def worker_command(argv: Sequence[str]) -> int:
    """0 stopped as asked, or what is checked holds; 1 no slot can start; 2 the settings cannot be used."""
    options = worker_parser().parse_args(argv)
    return _check(options.check) if options.check else _run(options.stop_with_stdin)


def _run(stop_with_stdin: bool) -> int:
    # Here and not above: a probe asks every few seconds and needs none of it.
    from pydantic import ValidationError
    from redis.exceptions import RedisError

    from refine_jobs.redis_server import RedisUnfit
    from refine_jobs.settings import OWNER_ONLY

    from .lifeline import stop_with_parent
    from .plan import PlanError
    from .supervisor import build_supervisor

    os.umask(OWNER_ONLY)
    try:
        supervisor = build_supervisor()
    except (ValidationError, PlanError, RedisUnfit, RedisError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    if stop_with_stdin:
        stop_with_parent()
    return supervisor.run()


def _check(probe: str) -> int:
    """Print the worker's answer."""
    port, host = os.environ.get("REFINE_WORKER_PORT"), os.environ.get("REFINE_WORKER_HOST", "")
    if not port:
        print("error: expected REFINE_WORKER_PORT, the port on which the worker answers", file=sys.stderr)
        return BAD_INPUT
    here = "127.0.0.1" if host in ("", "0.0.0.0") else host
    try:
        with urllib.request.urlopen(f"http://{here}:{port}{PROBES[probe]}", timeout=_ANSWER_S) as answer:
            print(answer.read().decode().strip())
            return 0
    except urllib.error.HTTPError as answer:
        print(answer.read().decode().strip())
    except OSError as error:
        print(f"not {probe}: no worker answers on port {port}: {error}")
    return FAILED
