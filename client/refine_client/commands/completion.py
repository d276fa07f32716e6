"""`refine completion SHELL`: a script that completes commands and options, made from the parsers."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from shlex import quote
from typing import NamedTuple

from ..cli import COMMANDS, installed_commands

SHELLS = ("bash", "zsh", "fish")
EPILOG = """\
install it, once and after each update
  bash   refine completion bash > ~/.local/share/bash-completion/completions/refine
  zsh    refine completion zsh > ~/.refine.zsh    and in ~/.zshrc, after compinit: source ~/.refine.zsh
  fish   refine completion fish > ~/.config/fish/completions/refine.fish
"""
# zsh runs the same function under its emulation of bash.
_BASH = """\
_refine() {
    local current="${COMP_WORDS[COMP_CWORD]}" words= hidden=
    [[ $current == -* ]] || hidden='--*' # where an option may stand, a file is likelier
    case "${COMP_WORDS[*]:1:$((COMP_CWORD - 1))} " in
CASES
    esac
    COMPREPLY=($(compgen -W "$words" -X "$hidden" -- "$current"))
}
complete -o default -F _refine refine
"""


class Place(NamedTuple):
    """Somewhere on a command line: which words may come next, and what they mean."""

    typed: tuple[str, ...]  # the command and its subcommand
    option: str  # whose value comes next; empty: none
    words: Mapping[str, str]


def completion_parser() -> argparse.ArgumentParser:
    """The arguments of `refine completion`."""
    parser = argparse.ArgumentParser(
        prog="refine completion",
        description="Print a script that lets a shell complete the commands of refine and their options.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("shell", choices=SHELLS)
    return parser


def completion_command(argv: Sequence[str]) -> int:
    """Run `refine completion`."""
    shell = completion_parser().parse_args(argv).shell
    installed = installed_commands()
    commands = {name: command.help for name, command in COMMANDS.items() if name in installed}
    places = [Place((), "", commands), Place(("help",), "", commands)]
    for name in commands:
        places += _places_of_command(name)
    if shell == "zsh":
        print("autoload -Uz bashcompinit && bashcompinit")
    print(_fish(places) if shell == "fish" else _bash(places))
    return 0


def _places_of_command(name: str) -> Iterator[Place]:
    """Of NAME_parser in the module of NAME's entry point; none if the command's extra is not installed."""
    try:
        module = import_module(installed_commands()[name].module)
    except ModuleNotFoundError:
        return
    yield from _places((name,), getattr(module, f"{name}_parser")())


def _places(typed: tuple[str, ...], parser: argparse.ArgumentParser) -> Iterator[Place]:
    """The inner ones first: the first that fits a command line is the right one."""
    words: dict[str, str] = {}
    for action in parser._actions:
        means = (action.help or "") % {**vars(action), "prog": parser.prog}
        if isinstance(action, argparse._SubParsersAction):
            words |= {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, inner in action.choices.items():
                yield from _places((*typed, name), inner)
        elif action.option_strings:
            words[action.option_strings[-1]] = means
            if action.choices:
                yield Place(typed, action.option_strings[-1], dict.fromkeys(map(str, action.choices), ""))
        elif action.choices:
            words |= dict.fromkeys(map(str, action.choices), "")
    yield Place(typed, "", words)


def _bash(places: Sequence[Place]) -> str:
    cases = []
    for place in places:
        value = f'"{place.option} "' if place.option else ""
        cases.append(f'        "{" ".join(place.typed)} "*{value}) words="{" ".join(place.words)}" ;;')
    return _BASH.replace("CASES", "\n".join(cases))


def _fish(places: Sequence[Place]) -> str:
    lines = []
    for place in places:
        tests = [f'test "$t[{number}]" = {word}' for number, word in enumerate(place.typed, start=2)]
        seen = quote("set -l t (commandline -opc); " + ("; and ".join(tests) or "test (count $t) = 1"))
        if place.option:
            lines.append(
                f"complete -c refine -n {seen} -l {place.option[2:]} -xa {quote(' '.join(place.words))}"
            )
            continue
        for word, means in place.words.items():
            what = f"-l {word[2:]}" if word.startswith("--") else f"-fa {word}"
            lines.append(f"complete -c refine -n {seen} {what} -d {quote(means)}")
    return "\n".join(lines)
