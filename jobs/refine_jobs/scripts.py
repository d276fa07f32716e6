"""The Lua scripts, in `lua/`: each is one atomic step of a job's life."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from . import keys

_FOLDER = Path(__file__).parent / "lua"


@cache
def script(name: str) -> str:
    """The whole text of a script: constants of keys.py, common.lua, the script."""
    return keys.lua_constants() + (_FOLDER / "common.lua").read_text() + (_FOLDER / f"{name}.lua").read_text()
