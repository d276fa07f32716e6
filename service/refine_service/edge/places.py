"""What holds memory as long as it lasts is done so many times at once, and no more."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from refine_proto.errors import QuotaExceeded, Unavailable

_RETRY_S = 2.0


class Places:
    """At most `count` at a time in this process, and three quarters of them for one owner."""

    def __init__(self, what: str, count: int) -> None:
        self._what, self._count = what, count
        self._share = max(1, count * 3 // 4)
        self._owners: Counter[str] = Counter()

    @contextmanager
    def take(self, owner: str) -> Iterator[None]:
        """Hold a place while inside; raises QuotaExceeded and Unavailable."""
        if self._owners[owner] >= self._share:
            raise QuotaExceeded(
                f"expected at most {self._share} {self._what} of one owner at a time, got more; "
                "try again when one has ended",
                retry_after_s=_RETRY_S,
            )
        if self._owners.total() >= self._count:
            raise Unavailable(
                f"expected at most {self._count} {self._what} at a time, got more; try again",
                retry_after_s=_RETRY_S,
            )
        self._owners[owner] += 1
        try:
            yield
        finally:
            self._owners[owner] -= 1
            if not self._owners[owner]:
                del self._owners[owner]
