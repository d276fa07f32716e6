"""`refine get | list | extend | cancel | delete | download`: refinements by their ids."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from refine_proto.commands.ending import Parser
from refine_proto.models import MeshCounts, Refinement, State

from .server_command import add_metadata, command, connect, make_parser, read_metadata


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
    example = (
        "  refine list --state failed --metadata set=chairs\n  refine list --limit 100 --json | jq -r .id"
    )
    parser = make_parser("list", "List your refinements, newest first.", example)
    parser.add_argument("--limit", type=int, default=20, metavar="N", help="how many (20)")
    parser.add_argument(
        "--state", action="append", default=[], choices=list(State), metavar="STATE",
        help=f"only those that are {', '.join(State)}, as often as there are any",
    )  # fmt: skip
    add_metadata(parser, "only those with this pair")
    return parser


@command
def list_command(argv: Sequence[str]) -> None:
    """Run `refine list`."""
    parser = list_parser()
    arguments = parser.parse_args(argv)
    if arguments.limit < 1:
        parser.error(f"expected --limit of at least 1, got {arguments.limit}")
    with connect(arguments) as client:
        found = client.list_all(state=arguments.state, metadata=read_metadata(arguments))
        for refinement in islice(found, arguments.limit):
            print(refinement.model_dump_json(exclude_none=True) if arguments.json else _line(refinement))


def extend_parser() -> Parser:
    """The arguments of `refine extend`."""
    parser = _with_id("extend", "Keep an ended refinement and its files for longer, or shorter, than usual.")
    parser.add_argument(
        "--lifetime-s", type=float, required=True, metavar="S", help="seconds from now until they are removed"
    )
    return parser


@command
def extend_command(argv: Sequence[str]) -> None:
    """Run `refine extend`."""
    arguments = extend_parser().parse_args(argv)
    with connect(arguments) as client:
        _show(client.extend(arguments.id, arguments.lifetime_s), arguments.json)


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
    """Id, age, state, preset, then what is known of it."""
    iou, progress, error = refinement.silhouette_iou, refinement.progress, refinement.error
    known = ""
    if not refinement.state.terminal:
        known = f"{progress.percent if progress is not None else 0.0:.0f} %"
    elif iou is not None:
        known = f"2D IoU {iou.before:.3f} -> {iou.after:.3f}"
    elif error is not None:
        known = error.reason
    preset = refinement.options.preset
    return f"{refinement.id}  {_age(refinement):>6}  {refinement.state:<10} {preset:<8} {known}".rstrip()


def _age(refinement: Refinement) -> str:
    """Since its submission, in the largest unit of which there are two."""
    seconds = max(0, int((datetime.now(UTC) - refinement.created_at).total_seconds()))
    for unit, length in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds // length} {unit}"
    return f"{seconds} s"


def _show(refinement: Refinement, as_json: bool) -> None:
    if as_json:
        print(refinement.model_dump_json(exclude_none=True))
        return
    iou, progress, error = refinement.silhouette_iou, refinement.progress, refinement.error
    eta_s = refinement.eta_s
    ahead, plane, turn = refinement.queue_position, refinement.mirror_plane, refinement.camera_correction
    camera = refinement.camera
    counts = refinement.mesh_counts
    rows = {
        "id": refinement.id,
        "state": str(refinement.state) + (f", {ahead} ahead" if ahead is not None else ""),
        "expected": eta_s is not None and f"in about {eta_s:.0f} s",
        "error": error and f"{error.reason}: {error.detail}",
        "progress": progress and f"{progress.iteration}/{progress.total} ({progress.percent:.0f} %)",
        "2D IoU": iou and f"{iou.before:.3f} -> {iou.after:.3f}",
        "outcome": refinement.outcome,
        "mirror": plane and f"{_numbers(plane.normal)} . x = {plane.offset:.4g}",
        "camera": turn and f"turned by {turn.turn_degrees:.1f} degrees",
        "metadata": ", ".join(f"{key}={value}" for key, value in refinement.metadata.items()),
        "estimated": camera
        and f"azimuth {camera.azimuth_degrees:.0f}, elevation {camera.elevation_degrees:.0f}",
        "vertices": counts and _vertices(counts),
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


def _vertices(counts: MeshCounts) -> str:
    told = f"{counts.vertices}"
    if counts.refined_vertices != counts.vertices:
        told += f", subdivided to {counts.refined_vertices}"
    if counts.optimised_vertices != counts.refined_vertices:
        told += f", {counts.optimised_vertices} optimised"
    return told


def _numbers(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"
