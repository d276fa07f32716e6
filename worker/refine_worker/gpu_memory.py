"""Memory of the cards, asked of the driver's management library, which needs no CUDA context."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import pynvml


@dataclass(frozen=True)
class GpuMemory:
    """Of a whole card, whoever uses it."""

    used_bytes: int
    size_bytes: int


def gpu_memory(uuid: str) -> GpuMemory | None:
    """Now; None where nothing tells. `uuid` as torch gives it, of a card or of a part of one (MIG)."""
    if not _started():
        return None
    for kind in ("GPU", "MIG"):
        try:
            memory = pynvml.nvmlDeviceGetMemoryInfo(pynvml.nvmlDeviceGetHandleByUUID(f"{kind}-{uuid}"))
        except pynvml.NVMLError:
            continue
        return GpuMemory(used_bytes=memory.used, size_bytes=memory.total)
    return None


@cache
def _started() -> bool:
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return False
    return True
