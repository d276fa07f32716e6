"""What strangers' files may cost while they are parsed; the operating system keeps to it."""

from __future__ import annotations

import math
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from refine_engine.errors import MeshInvalid

_NATIVE_S = 2  # beyond the limit, for native code to come back to Python
_AGAIN_S = 0.5  # a parser may have swallowed the first one


class _OutOfTime(BaseException):
    """No Exception: a parser's own `except` shall let it pass."""


@contextmanager
def parsing(cpu_s: float, memory_bytes: int) -> Iterator[None]:
    """Inside, the main thread has so much CPU time and this process may map so much more memory.

    Raises MeshInvalid when the time is over, and MemoryError when memory is (only Linux keeps to that).
    Native code that does not come back within _NATIVE_S ends its process, with SIGXCPU.
    """
    try:
        with _memory_limit(memory_bytes), _last_cpu_second(cpu_s + _NATIVE_S), _alarm_after(cpu_s):
            yield
    except _OutOfTime:
        raise MeshInvalid(too_slow(cpu_s)) from None


def too_slow(seconds: float) -> str:
    """What a caller is told of files that take longer."""
    return f"expected files that can be read in {seconds:.3g} s; simplify the mesh"


@contextmanager
def _alarm_after(cpu_s: float) -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise _OutOfTime

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, cpu_s, _AGAIN_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def _last_cpu_second(cpu_s: float) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_CPU)
    last = math.ceil(time.process_time() + cpu_s)
    resource.setrlimit(resource.RLIMIT_CPU, (_lowest(last, *before), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_CPU, before)


@contextmanager
def _memory_limit(bytes_more: int) -> Iterator[None]:
    if sys.platform != "linux":
        yield
        return
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_lowest(mapped + bytes_more, *before), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _lowest(*limits: int) -> int:
    return min(limit for limit in limits if limit != resource.RLIM_INFINITY)
