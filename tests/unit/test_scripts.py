"""The scripts: each explains itself, and CONTRIBUTING.md, CI and the commit hooks name what is there."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(path.name for path in (ROOT / "scripts").iterdir() if not path.name.startswith("_"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_shows_how_to_call_it(name: str, tmp_path: Path) -> None:
    answer = subprocess.run(
        [ROOT / "scripts" / name, "-h"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert answer.stderr == ""
    assert re.search(rf"^  scripts/{name}\b", answer.stdout, re.MULTILINE)


@pytest.mark.parametrize("name", SCRIPTS)
def test_contributing_names_it(name: str) -> None:
    assert f"scripts/{name}" in (ROOT / "CONTRIBUTING.md").read_text()


def test_ci_runs_everything() -> None:
    assert re.search(r"^exec .*/scripts/test\"$", (ROOT / ".ci/run").read_text(), re.MULTILINE)


def test_commit_hooks_call_words_of_check() -> None:
    called = re.findall(r"entry: scripts/check (.+)", (ROOT / ".pre-commit-config.yaml").read_text())
    words = re.findall(r"^ {8}(\w+)\) ", (ROOT / "scripts/check").read_text(), re.MULTILINE)
    assert called
    assert {word for entry in called for word in entry.split()} <= set(words)
