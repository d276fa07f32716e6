"""`refine keys`: make, show and revoke API keys, and the secrets that sign webhooks."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import timedelta

from refine_jobs.settings import JobSettings
from refine_proto.commands.ending import FAILED
from refine_proto.models import Priority

from ..edge.auth import ApiKeys
from ..settings import ServiceSettings
from .arguments import command, environment, make_parser


def keys_parser() -> argparse.ArgumentParser:
    """The arguments of `refine keys`."""
    parser = make_parser("keys", "Make, show and revoke API keys. A key is shown once, when it is made.")
    parser.add_argument("--keys-file", metavar="FILE", help="unset: keys.json in the data folder")
    actions = parser.add_subparsers(dest="action", required=True)
    add = actions.add_parser("add", help="make a key")
    add.add_argument("owner", help="whose jobs it reaches")
    add.add_argument(
        "--max-priority", type=Priority, choices=list(Priority), default=Priority.NORMAL,
        metavar="PRIORITY", help=f"the most that its jobs may ask for: {', '.join(Priority)} (normal)",
    )  # fmt: skip
    secret = actions.add_parser("webhook-secret", help="make a secret that signs the webhooks of an owner")
    secret.add_argument("owner", help="whose jobs")
    secret.add_argument(
        "--overlap-hours", type=float, default=24.0, metavar="H", help="earlier ones sign beside it for (24)"
    )
    actions.add_parser("list", help="show ids, dates, priorities and owners")
    actions.add_parser("revoke", help="refuse a key from now on").add_argument("id", help="as shown by list")
    return parser


@command
def keys_command(argv: Sequence[str]) -> int:
    """add OWNER [--max-priority PRIORITY], list, revoke ID. Running services see the change at once."""
    arguments = keys_parser().parse_args(argv)
    values = environment(arguments)
    settings = ServiceSettings.from_environment(values)
    keys = ApiKeys(settings.keys_path(JobSettings.from_environment(values).data_folder))
    if arguments.action == "add":
        key, secret = keys.add(arguments.owner, arguments.max_priority)
        print(secret)
        print(f"key {key.id} of {key.owner}; it is not shown again", file=sys.stderr)
    elif arguments.action == "webhook-secret":
        print(keys.add_webhook_secret(arguments.owner, timedelta(hours=arguments.overlap_hours)))
    elif arguments.action == "list":
        for key in keys.all():
            print(f"{key.id}  {key.created_at:%Y-%m-%d %H:%M}  {key.max_priority:<6}  {key.owner}")
    elif not keys.revoke(arguments.id):
        print(f"error: expected an id that `refine keys list` shows, got {arguments.id!r}", file=sys.stderr)
        return FAILED
    return 0
