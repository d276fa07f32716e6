"""The dispatcher `refine`: what it imports, what it says, which exit codes it gives."""

import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest

from refine_client import cli

ROOT = Path(__file__).parents[2]


def refine(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = "import sys; from refine_client.cli import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False
    )


def test_help_lists_the_installed_commands() -> None:
    answer = refine("--help")
    assert answer.returncode == 0
    listed = re.findall(r"^  (\w+) ", answer.stdout, re.MULTILINE)
    assert listed == [name for name in cli.COMMANDS if name in cli._installed()]
    assert "run" in listed


def test_help_imports_neither_torch_nor_numpy() -> None:
    program = (
        "import sys; from refine_client.cli import main; main(['--help']);"
        "print(sorted({'torch', 'numpy', 'rich', 'refine_engine'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert answer.stdout.splitlines()[-1] == "[]"


def test_every_entry_point_is_in_the_table() -> None:
    assert set(cli._installed()) <= set(cli.COMMANDS)


def test_no_arguments_prints_the_help_and_fails() -> None:
    answer = refine()
    assert answer.returncode == 2
    assert "usage: refine" in answer.stdout


@pytest.mark.parametrize(("typed", "meant"), [("rnu", "run"), ("sumbit", "submit"), ("evaluate", "eval")])
def test_unknown_command_names_the_nearest(
    typed: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([typed]) == 2
    assert (
        capsys.readouterr().err
        == f"error: expected a command of refine, got '{typed}'; did you mean {meant}?\n"
    )


def test_unknown_command_without_a_near_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["xyzzy"]) == 2
    assert "refine --help lists them" in capsys.readouterr().err


class Loaded(NamedTuple):
    """An entry point whose object is at hand."""

    command: Callable[[Sequence[str]], int]

    def load(self) -> Callable[[Sequence[str]], int]:
        return self.command


def entry_point(target: str) -> dict[str, metadata.EntryPoint]:
    return {"run": metadata.EntryPoint("run", target, "refine.commands")}


def test_missing_extra_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_installed", lambda: entry_point("no_such_package.run:run_command"))
    assert cli.main(["run"]) == 2
    error = (
        "error: refine run needs no_such_package, which is not installed; pip install 'refine-mesh[engine]'\n"
    )
    assert capsys.readouterr().err == error


def test_command_that_this_installation_lacks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_installed", dict)
    assert cli.main(["worker"]) == 2
    assert "pip install 'refine-mesh[worker]'" in capsys.readouterr().err


def test_arguments_and_exit_code_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    received: list[Sequence[str]] = []

    def command(argv: Sequence[str]) -> int:
        received.append(argv)
        return 7

    monkeypatch.setattr(cli, "_installed", lambda: {"run": Loaded(command)})
    assert cli.main(["run", "mesh.glb", "--json"]) == 7
    assert received == [["mesh.glb", "--json"]]


def test_interrupt_is_130_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(argv: Sequence[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_installed", lambda: {"run": Loaded(command)})
    assert cli.main(["run"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_version_is_the_newest_of_the_changelog() -> None:
    newest = re.search(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest
    assert refine("--version").stdout == f"refine {newest[1]}\n"
