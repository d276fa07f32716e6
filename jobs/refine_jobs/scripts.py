"""The Lua scripts, in `lua/`: each is one atomic step of a job's life."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from . import keys

_FOLDER = Path(__file__).parent / "lua"
_COMMON = "common"
Clock = Callable[[], int]
"""Milliseconds since 1970."""


@cache
def script(name: str) -> str:
    """The whole text of a script: constants of keys.py, common.lua, the script."""
    return keys.lua_constants() + "".join((_FOLDER / f"{n}.lua").read_text() for n in (_COMMON, name))


class Scripts:
    """All scripts over one connection; asynchronous if that is. `clock` replaces the Redis server's."""

    def __init__(self, redis: Any, clock: Clock | None = None) -> None:
        names = {path.stem for path in _FOLDER.glob("*.lua")} - {_COMMON}
        self._registered = {name: redis.register_script(script(name)) for name in names}
        self._clock = clock

    def run(self, name: str, *args: Any) -> Any:
        """What the script returns."""
        return self._registered[name](keys=[self._clock()] if self._clock else [], args=args)
