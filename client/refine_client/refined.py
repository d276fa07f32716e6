"""What both clients share beyond their transports: what `refine` returns, and how much they do at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from refine_proto.models import Event, Refinement

PAGE = 100  # refinements, the longest that a server gives
AT_ONCE = 8  # cases


@dataclass(frozen=True)
class Refined:
    """What `refine` returns: the succeeded refinement, and its artifacts on disk by name."""

    refinement: Refinement
    files: Mapping[str, Path]


def tell_nobody(event: Event) -> None:
    """In the place of a caller's function that was not given."""
