"""Numba's compiler, with its cache on disk wherever there is a folder for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def numba_jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(nogil=True, cache=True)`; where no folder can be written, each process compiles for itself.

    Numba refuses to define a cached function there: a container with a read-only root could not start.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return njit(nogil=True, cache=True, **options)(function)
        except RuntimeError:  # "cannot cache function": in $NUMBA_CACHE_DIR, __pycache__ or the user's cache
            return njit(nogil=True, **options)(function)

    return compiled
