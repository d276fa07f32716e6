"""What the shells are told: checked by asking each shell that is here."""

from __future__ import annotations

import io
import shutil
import subprocess
from contextlib import redirect_stdout

import pytest

from refine_client.commands.completion import SHELLS, completion_command

QUESTIONS = [
    ("sub", {"submit"}),
    ("help down", {"download"}),
    ("run --pre", {"--preset"}),
    ("run mesh.obj --preset ", {"paper", "default", "fast"}),
    ("keys ", {"add", "list", "revoke", "rotate", "webhook-secret"}),
    ("keys rev", {"revoke"}),
    ("bench synthetic --sub", {"--subset"}),
    ("bench synthetic --level m", {"mild"}),
    ("docs conv", {"conventions"}),
    ("completion ", set(SHELLS)),
    ("run coarse", set()),  # a file: the shell's own completion
]

ANSWER = r'''COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _refine; printf "%s\n" "${COMPREPLY[@]}"'''


@pytest.fixture(scope="module")
def scripts() -> dict[str, str]:
    """By shell; the engine is imported for the first one."""
    made = {}
    for shell in SHELLS:
        with redirect_stdout(io.StringIO()) as printed:
            assert completion_command([shell]) == 0
        made[shell] = printed.getvalue()
    return made


def ask(command: list[str]) -> set[str]:
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert answer.stderr == ""
    return {line.split("\t")[0] for line in answer.stdout.splitlines() if line}


@pytest.mark.skipif(not shutil.which("bash"), reason="bash is not here")
@pytest.mark.parametrize(("typed", "offered"), QUESTIONS)
def test_bash(scripts: dict[str, str], typed: str, offered: set[str]) -> None:
    words = " ".join(f"'{word}'" for word in ["refine", *typed.split(" ")])
    question = f"COMP_WORDS=({words}); {ANSWER}"
    assert ask(["bash", "-c", f"{scripts['bash']}\n{question}"]) == offered


@pytest.mark.skipif(not shutil.which("zsh"), reason="zsh is not here")
@pytest.mark.parametrize(("typed", "offered"), QUESTIONS)
def test_zsh(scripts: dict[str, str], typed: str, offered: set[str]) -> None:
    """The function in the emulation in which bashcompinit calls it; zsh takes those words that fit."""
    words = " ".join(f"'{word}'" for word in ["refine", *typed.split(" ")])
    question = (
        f"ask() {{ emulate -L sh; setopt kshglob noshglob braceexpand; typeset -a COMP_WORDS=({words}); "
        f"{ANSWER}; }}; ask"
    )
    start = "autoload -Uz compinit; compinit -D"
    answer = ask(["zsh", "-f", "-c", f"{start}\n{scripts['zsh']}\n{question}"])
    assert {word for word in answer if word.startswith(typed.split(" ")[-1])} == offered


@pytest.mark.skipif(not shutil.which("fish"), reason="fish is not here")
@pytest.mark.parametrize(("typed", "offered"), QUESTIONS)
def test_fish(scripts: dict[str, str], typed: str, offered: set[str]) -> None:
    assert ask(["fish", "-c", f"{scripts['fish']}\ncomplete -C 'refine {typed}'"]) == offered
