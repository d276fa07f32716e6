"""`refine keys`: make, show, rotate and revoke API keys, and the secrets that sign webhooks."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

from refine_jobs.settings import OWNER_ONLY, JobSettings
from refine_proto.commands.ending import FAILED
from refine_proto.models import Priority

from ..edge.auth import ApiKey, ApiKeys, Scope
from ..settings import ServiceSettings
from .arguments import command, environment, make_parser


def keys_parser() -> argparse.ArgumentParser:
    """The arguments of `refine keys`."""
    parser = make_parser("keys", "Make, show, rotate and revoke API keys. A new key is shown once.")
    parser.add_argument("--keys-file", metavar="FILE", help="unset: keys.json in the data folder")
    actions = parser.add_subparsers(dest="action", required=True)
    add = actions.add_parser("add", help="make a key")
    add.add_argument("owner", help="whose jobs it reaches")
    add.add_argument(
        "--max-priority", type=Priority, choices=list(Priority), default=Priority.NORMAL,
        metavar="PRIORITY", help=f"the most that its jobs may ask for: {', '.join(Priority)} (normal)",
    )  # fmt: skip
    add.add_argument(
        "--scope",
        action="append",
        choices=[scope.value for scope in Scope],
        help="what it lets its owner do, may be repeated (submit and read)",
    )
    add.add_argument("--expires-days", type=_positive, metavar="N", help="refuse it from then on (never)")
    rotate = actions.add_parser("rotate", help="make a key in the place of one that ends soon")
    rotate.add_argument("id", help="as shown by list")
    rotate.add_argument(
        "--overlap-hours", type=_positive, default=24.0, metavar="H", help="both are good for (24)"
    )
    secret = actions.add_parser("webhook-secret", help="make a secret that signs the webhooks of an owner")
    secret.add_argument("owner", help="whose jobs")
    secret.add_argument(
        "--overlap-hours", type=float, default=24.0, metavar="H", help="earlier ones sign beside it for (24)"
    )
    actions.add_parser("list", help="show ids, owners, scopes, priorities and dates")
    actions.add_parser("revoke", help="refuse a key from now on").add_argument("id", help="as shown by list")
    return parser


@command
def keys_command(argv: Sequence[str]) -> int:
    """add OWNER, list, rotate ID, revoke ID. Running services see the change at once."""
    arguments = keys_parser().parse_args(argv)
    os.umask(OWNER_ONLY)
    values = environment(arguments)
    settings = ServiceSettings.from_environment(values)
    keys = ApiKeys(settings.keys_path(JobSettings.from_environment(values).data_folder))
    if arguments.action == "add":
        days = arguments.expires_days
        expires_at = datetime.now(UTC) + timedelta(days=days) if days else None
        scopes = [Scope(name) for name in arguments.scope or ()]
        _show(*keys.add(arguments.owner, scopes, expires_at, arguments.max_priority))
    elif arguments.action == "webhook-secret":
        print(keys.add_webhook_secret(arguments.owner, timedelta(hours=arguments.overlap_hours)))
    elif arguments.action == "list":
        for key in keys.all():
            print(_line(key))
    elif arguments.action == "rotate":
        made = keys.rotate(arguments.id, timedelta(hours=arguments.overlap_hours))
        if made is None:
            return _unknown(arguments.id)
        _show(*made)
    elif not keys.revoke(arguments.id):
        return _unknown(arguments.id)
    return 0


def _show(key: ApiKey, secret: str) -> None:
    print(secret)
    print(f"key {key.id} of {key.owner}; it is not shown again", file=sys.stderr)


def _line(key: ApiKey) -> str:
    end = "" if key.expires_at is None else f"  until {key.expires_at:%Y-%m-%d %H:%M}"
    rights = f"{','.join(key.scopes)}  {key.max_priority}"
    return f"{key.id}  {key.created_at:%Y-%m-%d %H:%M}  {key.owner}  {rights}{end}"


def _unknown(key_id: str) -> int:
    print(f"error: expected an id that `refine keys list` shows, got {key_id!r}", file=sys.stderr)
    return FAILED


def _positive(text: str) -> float:
    number = float(text)
    if not 0 < number < 36_500:
        raise argparse.ArgumentTypeError(f"expected a number above 0 and below 36500, got {text}")
    return number
