"""The dispatcher `refine`: what it imports, what it says, which exit codes it gives."""

import os
import re
import subprocess
import sys
import tomllib
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from importlib import import_module, metadata
from pathlib import Path
from typing import NamedTuple

import pytest

from refine_client import cli
from refine_proto.commands import cores
from refine_proto.models import RefinementOptions

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
    assert listed == [name for name in cli.COMMANDS if name in cli.installed_commands()]
    assert "run" in listed


def test_help_of_a_command_is_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        cli.main(["help", "submit"])
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith("usage: refine submit ")
    assert cli.main(["help", "sumbit"]) == 2
    assert "did you mean submit?" in capsys.readouterr().err


def test_the_client_is_the_command_too() -> None:
    answer = subprocess.run(
        [sys.executable, "-m", "refine_client", "--version"], capture_output=True, text=True, check=True
    )
    assert answer.stdout == refine("--version").stdout


def test_help_imports_neither_torch_nor_numpy() -> None:
    program = (
        "import sys; from refine_client.cli import main; main(['--help']);"
        "print(sorted({'torch', 'numpy', 'rich', 'refine_engine'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert answer.stdout.splitlines()[-1] == "[]"


def test_the_table_and_the_entry_points_agree() -> None:
    assert set(cli.installed_commands()) == set(cli.COMMANDS)


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_a_parser_that_names_what_a_user_has(name: str) -> None:
    """No path into a clone: `refine docs PAGE` prints what an installation carries."""
    parser = parser_of(name)
    shown = parser.format_help()
    assert shown.startswith(f"usage: refine {name} ")
    assert "docs/" not in shown
    for page in re.findall(r"refine docs (\w+)", shown):
        assert (ROOT / f"docs/{page}.md").exists()


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


def test_run_and_submit_take_the_same_options() -> None:
    files = ["mesh", "silhouette", "--camera", "camera"]
    run = vars(parser_of("run").parse_args([*files, "-o", "out"]))
    submit = vars(parser_of("submit").parse_args(files))
    options = set(RefinementOptions.model_fields)
    assert options & set(submit) == options
    assert options & set(run) == options - {"timeout_s", "priority"}


def test_no_command_takes_more_cores_than_its_container_allows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(cores, "CONTROL_GROUP", tmp_path)
    (tmp_path / "cpu.max").write_text("200000 100000\n")
    assert parser_of("run").get_default("threads") == 2
    assert parser_of("bench").parse_args(["synthetic"]).threads == 2


def parser_of(name: str) -> ArgumentParser:
    module = import_module(cli.installed_commands()[name].module)
    parser: ArgumentParser = getattr(module, f"{name}_parser")()
    return parser


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
    monkeypatch.setattr(cli, "installed_commands", lambda: entry_point("no_such_package.run:run_command"))
    assert cli.main(["run"]) == 2
    error = (
        "error: refine run needs no_such_package, which is not installed; pip install 'refine-mesh[engine]'\n"
    )
    assert capsys.readouterr().err == error


def test_command_that_this_installation_lacks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "installed_commands", dict)
    assert cli.main(["worker"]) == 2
    assert "refine worker is not part of this installation" in capsys.readouterr().err


@pytest.fixture
def without_torch(tmp_path: Path) -> dict[str, str]:
    """The environment of a Python that finds no torch, as after `pip install '.[service]'`."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Hider:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'torch':\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Hider())\n"
    )
    return {**os.environ, "PYTHONPATH": str(tmp_path)}


@pytest.mark.parametrize(
    ("name", "extras"),
    [("serve", "service,worker"), ("worker", "worker"), ("run", "engine"), ("bench", "bench")],
)
def test_a_missing_extra_is_told_before_anything_starts(
    name: str, extras: str, without_torch: dict[str, str], tmp_path: Path
) -> None:
    answer = subprocess.run(
        [sys.executable, "-m", "refine_client", name],
        env={**without_torch, "REFINE_DATA_FOLDER": str(tmp_path / "data")},
        capture_output=True,
        text=True,
        timeout=60,
    )
    error = f"error: refine {name} needs torch, which is not installed; pip install 'refine-mesh[{extras}]'\n"
    assert (answer.returncode, answer.stdout, answer.stderr) == (2, "", error)
    assert not (tmp_path / "data").exists()


def test_the_modules_that_tell_of_an_extra_are_those_it_brings() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]

    def brought(extra: str) -> set[str]:
        names = {re.match(r"[\w-]+(\[.*?\])?", requirement)[0] for requirement in declared[extra]}  # type: ignore[index]
        inner = [
            name[len("refine-mesh[") : -1].split(",") for name in names if name.startswith("refine-mesh[")
        ]
        return names.union(*(brought(each) for group in inner for each in group))

    for extra, modules in cli.MODULES_OF_EXTRA.items():
        assert set(modules) <= brought(extra)
    assert {extra for command in cli.COMMANDS.values() for extra in command.extras} == set(
        cli.MODULES_OF_EXTRA
    )


def test_arguments_and_exit_code_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    received: list[Sequence[str]] = []

    def command(argv: Sequence[str]) -> int:
        received.append(argv)
        return 7

    monkeypatch.setattr(cli, "installed_commands", lambda: {"run": Loaded(command)})
    assert cli.main(["run", "mesh.glb", "--json"]) == 7
    assert received == [["mesh.glb", "--json"]]


def test_interrupt_is_130_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(argv: Sequence[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "installed_commands", lambda: {"run": Loaded(command)})
    assert cli.main(["run"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_version_is_the_newest_of_the_changelog() -> None:
    newest = re.search(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest
    assert refine("--version").stdout == f"refine {newest[1]}\n"
