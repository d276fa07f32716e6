"""`refine get | list | cancel | delete | download`: refinements by their ids."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from refine_proto.commands.ending import Parser
from refine_proto.models import Refinement

from .server_command import command, connect, make_parser


def get_parser() -> Parser:
    """The arguments of `refine get`."""
    return _with_id("get", "Show one refinement.")


@command
def get_command(argv: Sequence[str]) -> None:
    """Run `refine get`."""
    arguments = get_parser().parse_args(argv)
    with connect(arguments) as client:
        _show(client.get(arguments.id), arguments.json)


def list_parser() -> Parser:
    """The arguments of `refine list`."""
    parser = make_parser(
        "list", "List your refinements, newest first.", "  refine list --limit 100 --json | jq -r .id"
    )
    parser.add_argument("--limit", type=int, default=20, metavar="N", help="how many (20)")
    return parser


@command
def list_command(argv: Sequence[str]) -> None:
    """Run `refine list`."""
    parser = list_parser()
    arguments = parser.parse_args(argv)
    if arguments.limit < 1:
        parser.error(f"expected --limit of at least 1, got {arguments.limit}")
    left, cursor = arguments.limit, None
    with connect(arguments) as client:
        while left > 0:
            page = client.list(limit=min(left, 100), cursor=cursor)
            for refinement in page.refinements[:left]:
                print(refinement.model_dump_json(exclude_none=True) if arguments.json else _line(refinement))
            left, cursor = left - len(page.refinements), page.next_cursor
            if cursor is None:
                break


def cancel_parser() -> Parser:
    """The arguments of `refine cancel`."""
    return _with_id("cancel", "Cancel a queued or running refinement; one that has ended stays as it is.")


@command
def cancel_command(argv: Sequence[str]) -> None:
    """Run `refine cancel`."""
    arguments = cancel_parser().parse_args(argv)
    with connect(arguments) as client:
        _show(client.cancel(arguments.id), arguments.json)


def delete_parser() -> Parser:
    """The arguments of `refine delete`."""
    return _with_id("delete", "Remove a refinement and its files; a running one must be cancelled first.")


@command
def delete_command(argv: Sequence[str]) -> None:
    """Run `refine delete`."""
    arguments = delete_parser().parse_args(argv)
    with connect(arguments) as client:
        client.delete(arguments.id)
    print(json.dumps({"id": arguments.id, "deleted": True}) if arguments.json else f"{arguments.id} deleted")


def download_parser() -> Parser:
    """The arguments of `refine download`."""
    example = "  refine download ID -o out\n  refine download ID refined.glb report.json -o out"
    parser = make_parser("download", "Fetch the artifacts of a refinement, each checked and whole.", example)
    parser.add_argument("id", metavar="ID")
    parser.add_argument("names", nargs="*", metavar="NAME", help="which artifacts (all)")
    parser.add_argument("-o", "--output", type=Path, default=Path(), metavar="DIR", help="where to (here)")
    return parser


@command
def download_command(argv: Sequence[str]) -> None:
    """Run `refine download`."""
    arguments = download_parser().parse_args(argv)
    with connect(arguments) as client:
        files = client.download(arguments.id, arguments.output, arguments.names or None)
    paths = {name: str(path) for name, path in files.items()}
    print(json.dumps(paths) if arguments.json else "\n".join(paths.values()))


def _with_id(name: str, description: str) -> Parser:
    parser = make_parser(name, description, f"  refine {name} ID")
    parser.add_argument("id", metavar="ID")
    return parser


def _line(refinement: Refinement) -> str:
    created = refinement.created_at.astimezone().strftime("%Y-%m-%d %H:%M:%S")
    percent = refinement.progress.percent if refinement.progress is not None else 0.0
    done = f"{percent:4.0f} %" if not refinement.state.terminal else ""
    reason = refinement.error.reason if refinement.error is not None else ""
    return f"{refinement.id}  {created}  {refinement.state:<10}{done}{reason}".rstrip()


def _show(refinement: Refinement, as_json: bool) -> None:
    if as_json:
        print(refinement.model_dump_json(exclude_none=True))
        return
    iou, progress, error = refinement.silhouette_iou, refinement.progress, refinement.error
    ahead, plane, turn = refinement.queue_position, refinement.mirror_plane, refinement.camera_correction
    rows = {
        "id": refinement.id,
        "state": str(refinement.state) + (f", {ahead} ahead" if ahead is not None else ""),
        "error": error and f"{error.reason}: {error.detail}",
        "progress": progress and f"{progress.iteration}/{progress.total} ({progress.percent:.0f} %)",
        "2D IoU": iou and f"{iou.before:.3f} -> {iou.after:.3f}",
        "outcome": refinement.outcome,
        "mirror": plane and f"{_numbers(plane.normal)} . x = {plane.offset:.4g}",
        "camera": turn and f"turned by {turn.turn_degrees:.1f} degrees",
        "warnings": "\n           ".join(refinement.warnings),
        "webhook": _deliveries(refinement),
        "created": refinement.created_at.isoformat(timespec="seconds"),
        "finished": refinement.finished_at and refinement.finished_at.isoformat(timespec="seconds"),
        "expires": refinement.expires_at.isoformat(timespec="seconds"),
        "artifacts": ", ".join(artifact.name for artifact in refinement.artifacts),
    }
    print("\n".join(f"{name:<10} {value}" for name, value in rows.items() if value))


def _deliveries(refinement: Refinement) -> str:
    return "\n           ".join(
        f"attempt {delivery.attempt} at {delivery.time.isoformat(timespec='seconds')}: "
        + (delivery.error or f"delivered ({delivery.status})")
        for delivery in refinement.webhook_deliveries
    )


def _numbers(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"
