"""How many connections the limit of open files allows."""

from __future__ import annotations

import logging
import resource

_KEPT = 64  # for Redis, logs, and what a process has open anyway

log = logging.getLogger(__name__)


def connections_of_each_transport(wanted: int) -> int:
    """At most `wanted`, after the process has been given as many descriptors as it may have.

    Either transport gets a third; the rest is for the files of uploads and downloads.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            soft = hard
        except (OSError, ValueError):  # macOS has a lower limit than the one that it tells
            pass
    if soft == resource.RLIM_INFINITY:
        return wanted
    possible = max(8, (soft - _KEPT) // 3)
    if possible < wanted:
        log.warning(
            "REFINE_MAX_CONNECTIONS is %d, but %d open files allow %d connections over HTTP and as many over "
            "gRPC; raise the limit of open files (ulimit -n)",
            wanted,
            soft,
            possible,
        )
    return min(wanted, possible)
