"""How much memory this process and its children may use together."""

from __future__ import annotations

import os
from pathlib import Path

CONTROL_GROUP = Path("/sys/fs/cgroup")
_LIMITS = ("memory.max", "memory/memory.limit_in_bytes")  # of version 2, then 1


def usable_memory_bytes() -> int:
    """The memory of the machine, or what its container allows if that is less."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in _LIMITS:
        try:
            return min(machine, int((CONTROL_GROUP / name).read_text()))
        except (OSError, ValueError):  # another version; "max"
            continue
    return machine
