"""Following one refinement over any number of connections: every event once, in order."""

from __future__ import annotations

import time

from refine_proto.errors import Busy, InvalidInput
from refine_proto.models import Event, EventType

from .retry import Retries, RetryPolicy

LONGEST_CONNECTION_S = 300.0
"""A watch moves to a fresh connection after at most this, so that one which died unnoticed is left."""


class Follow:
    """Where a watch is: the last sequence it has seen, the time it has left, its retries."""

    def __init__(
        self, refinement_id: str, after_sequence: int, timeout_s: float | None, policy: RetryPolicy
    ) -> None:
        if after_sequence < 0:
            raise InvalidInput(f"expected after_sequence of at least 0, got {after_sequence}")
        self._refinement_id = refinement_id
        self._timeout_s = timeout_s
        self._started = time.monotonic()
        self._retries = Retries(policy)
        self.sequence = after_sequence
        self.done = False

    def accept(self, event: Event) -> bool:
        """Whether the event is new; remembers it."""
        if event.sequence <= self.sequence:
            return False
        self.sequence = event.sequence
        self.done = event.type is EventType.COMPLETED
        self._retries.reset()
        return True

    def longest_s(self) -> float:
        """For the next connection; TimeoutError when the time is up."""
        if self._timeout_s is None:
            return LONGEST_CONNECTION_S
        left_s = self._started + self._timeout_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError(
                f"expected refinement {self._refinement_id} to end within {self._timeout_s:g} s; "
                "it goes on: wait again, or cancel it"
            )
        return min(left_s, LONGEST_CONNECTION_S)

    def delay_s(self, error: Busy) -> float:
        """Before the next connection; raises `error` when enough have failed in a row."""
        return min(self._retries.delay_s(error), self.longest_s())
