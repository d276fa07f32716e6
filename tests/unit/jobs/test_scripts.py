"""The text of the Lua scripts: the constants that they use, and no others."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import refine_jobs
from refine_jobs import keys
from refine_jobs.scripts import script

FOLDER = Path(refine_jobs.__file__).parent / "lua"
OWN = {"ARGV", "KEYS", "NOW"}


def test_the_scripts_use_every_constant_that_they_get_and_no_other() -> None:
    given = re.findall(r"^local (\w+) =", keys.lua_constants(), re.MULTILINE)
    code = "\n".join(path.read_text() for path in FOLDER.glob("*.lua"))
    code = re.sub(r"--.*|'[^'\n]*'", "", code)
    assert set(re.findall(r"\b[A-Z][A-Z_]+\b", code)) - OWN == set(given)
    for name in given:
        assert f"local {name} = {getattr(keys, name)!r}\n" in keys.lua_constants()


def test_the_page_of_the_scripts_names_each_of_them() -> None:
    named = re.findall(r"^\| `(\w+)` \|", (FOLDER / "README.md").read_text(), re.MULTILINE)
    assert sorted(named) == sorted({path.stem for path in FOLDER.glob("*.lua")} - {"common"})


def test_the_package_says_what_each_of_its_modules_is() -> None:
    named = re.findall(r"^(\w+)(?:, lua/)?  +\w", refine_jobs.__doc__ or "", re.MULTILINE)
    assert sorted(named) == sorted({path.stem for path in FOLDER.parent.glob("*.py")} - {"__init__"})


def test_a_constant_of_python_changes_no_script(monkeypatch: pytest.MonkeyPatch) -> None:
    """Redis knows a script by the hash of its text."""
    before = script.__wrapped__("claim")
    monkeypatch.setattr(keys, "BRAND_NEW", "refine:new", raising=False)
    assert script.__wrapped__("claim") == before
