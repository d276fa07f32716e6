"""When to try again."""

from __future__ import annotations

import random
from dataclasses import dataclass

from refine_proto.errors import Busy


@dataclass(frozen=True)
class RetryPolicy:
    """How often and how soon a call is repeated after a `Busy` error (429, 503, a lost connection).

    Every call is safe to repeat: a submission carries an idempotency key that stays the same.
    """

    retries: int = 4
    """Repetitions after the first try; 0 switches them off. Of a watch: in a row without an event."""
    first_delay_s: float = 0.5
    """Before the first repetition; doubles with each. Between half and all of it is slept, at random."""
    longest_delay_s: float = 8.0
    """Where the doubling ends."""
    longest_retry_after_s: float = 60.0
    """A server's Retry-After is obeyed up to this; beyond it the error is raised at once."""


class Retries:
    """The repetitions of one call."""

    def __init__(self, policy: RetryPolicy) -> None:
        self.policy = policy
        self.count = 0

    def delay_s(self, error: Busy) -> float:
        """How long to sleep before the next try; raises `error` if there is to be none."""
        policy = self.policy
        wanted = error.retry_after_s
        if self.count >= policy.retries or (wanted is not None and wanted > policy.longest_retry_after_s):
            raise error
        delay = min(policy.first_delay_s * 2.0**self.count, policy.longest_delay_s)
        self.count += 1
        if wanted is None:
            return delay * random.uniform(0.5, 1.0)
        return wanted + policy.first_delay_s * random.uniform(0.0, 0.5)  # not all callers at once

    def reset(self) -> None:
        """The call got on: count from the beginning."""
        self.count = 0
