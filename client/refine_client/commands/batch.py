"""`refine submit --batch`: many refinements of one file; with -o, all the way to their artifacts."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from refine_proto.commands.ending import FAILED, Parser
from refine_proto.errors import RefineError
from refine_proto.models import Event, EventType, Refinement

from ..cases import read_cases
from ..refined import AT_ONCE, Refined
from .server_command import connect, make_parser

EXAMPLE = """\
  refine submit --batch cases.jsonl -o out      the artifacts of the first case go to out/0001
  refine submit --batch cases.jsonl             only sends them; prints an id, or an error, for each

cases.jsonl, one case a line, with paths from its folder, or https addresses
  {"mesh": "a.glb", "silhouette": "a.png", "camera": "a.json", "options": {"preset": "fast"}}
  {"mesh": "b.glb", "silhouette": "b.png", "camera": {"type": "look_at", ...}, "metadata": {"set": "chairs"}}
"""


def batch_parser() -> Parser:
    """The arguments of `refine submit --batch`."""
    parser = make_parser("submit", "Send many refinements; one that fails does not stop the others.", EXAMPLE)
    parser.add_argument("--batch", type=Path, required=True, metavar="CASES.jsonl", help="what to send")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="wait, then download all artifacts")
    parser.add_argument("--at-once", type=int, default=AT_ONCE, metavar="N", help=f"with -o ({AT_ONCE})")
    parser.add_argument(
        "--idempotency-key", metavar="KEY", help="the same key and cases give the same refinements, and go on"
    )
    return parser


def run_batch(argv: Sequence[str]) -> int:
    """0 if all went well, 1 if one did not."""
    parser = batch_parser()
    arguments = parser.parse_args(argv)
    if arguments.at_once < 1:
        parser.error(f"expected --at-once of at least 1, got {arguments.at_once}")
    cases, failed = read_cases(arguments.batch), 0
    with connect(arguments) as client:
        if arguments.output is None:
            sent = client.submit_many(cases, idempotency_key=arguments.idempotency_key)
            outcomes: Sequence[Refinement | Refined | RefineError | OSError] = sent
        else:
            outcomes = client.refine_many(
                cases,
                arguments.output,
                idempotency_key=arguments.idempotency_key,
                at_once=arguments.at_once,
                progress=_show,
            )
    for number, outcome in enumerate(outcomes, 1):
        failed += isinstance(outcome, Exception)
        print(_json(number, outcome) if arguments.json else _line(number, outcome))
    print(f"{len(outcomes) - failed} of {len(outcomes)} cases went well", file=sys.stderr)
    return FAILED if failed else 0


def _show(number: int, event: Event) -> None:
    if event.type is not EventType.PROGRESS:
        print(f"{number:04d} {event.state}", file=sys.stderr, flush=True)


def _line(number: int, outcome: Refinement | Refined | RefineError | OSError) -> str:
    match outcome:
        case Refined(refinement=refinement):
            iou = refinement.silhouette_iou
            gained = f"  2D IoU {iou.before:.3f} -> {iou.after:.3f}" if iou else ""
            return f"{number:04d}  {refinement.id}  {refinement.state}{gained}"
        case Refinement():
            return f"{number:04d}  {outcome.id}  {outcome.state}"
        case RefineError():
            return f"{number:04d}  error: {outcome.reason}: {outcome.detail}"
        case _:
            return f"{number:04d}  error: {outcome}"


def _json(number: int, outcome: Refinement | Refined | RefineError | OSError) -> str:
    """`number` and either `refinement`, with `files` if they were fetched, or `error`."""
    shown: dict[str, object] = {"number": number}
    match outcome:
        case Refined(refinement=refinement, files=files):
            shown["refinement"] = refinement.model_dump(mode="json", exclude_none=True)
            shown["files"] = {name: str(path) for name, path in files.items()}
        case Refinement():
            shown["refinement"] = outcome.model_dump(mode="json", exclude_none=True)
        case RefineError():
            shown["error"] = outcome.problem().model_dump(mode="json", exclude_none=True)
        case _:
            shown["error"] = {"detail": str(outcome)}
    return json.dumps(shown)
