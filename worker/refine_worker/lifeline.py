"""Ends a process whose parent is gone, however the parent ended."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def stop_with_parent() -> None:
    """Send this process SIGTERM when its standard input closes: the parent holds the other end."""
    threading.Thread(target=_wait_for_end, name="lifeline", daemon=True).start()


def die_with_parent(parent: int) -> None:
    """Have Linux kill this process when `parent`, which started it, has ended.

    No code of ours has to run for that: it also ends a process that is in a native call and holds the GIL.
    Elsewhere nothing happens; there a thread that reads from the parent must do.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before that was set
        os._exit(1)


def _wait_for_end() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
