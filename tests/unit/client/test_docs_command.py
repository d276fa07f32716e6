"""`refine docs` prints the pages of docs/, from a clone and from an installation."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from refine_client.commands import docs
from refine_client.commands.docs import docs_command

ROOT = Path(__file__).parents[3]
Output = pytest.CaptureFixture[str]


@pytest.mark.parametrize("page", [path.stem for path in sorted((ROOT / "docs").glob("*.md"))])
def test_every_page_is_printed(page: str, capsys: Output) -> None:
    assert docs_command([page]) == 0
    assert capsys.readouterr().out == (ROOT / f"docs/{page}.md").read_text(encoding="utf-8")


def test_without_a_page_it_says_which_there_are(capsys: Output) -> None:
    assert docs_command([]) == 0
    shown = capsys.readouterr().out
    assert "conventions.md" in shown
    with pytest.raises(SystemExit) as caught:
        docs_command(["convention"])
    assert caught.value.code == 2
    assert "conventions" in capsys.readouterr().err


def test_an_installation_carries_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Output
) -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"]["docs"] == "refine_docs"
    (tmp_path / "refine_docs").symlink_to(ROOT / "docs")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(docs, "_CLONE", tmp_path / "no-clone")
    assert docs_command(["worker"]) == 0
    assert capsys.readouterr().out.startswith("# The worker")
