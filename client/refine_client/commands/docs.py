"""`refine docs [PAGE]`: print a page of the documentation; an installation carries all of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

_CLONE = Path(__file__).parents[3] / "docs"
_FIRST = "README"


def docs_parser() -> argparse.ArgumentParser:
    """The arguments of `refine docs`."""
    parser = argparse.ArgumentParser(
        prog="refine docs", description="Print a page of the documentation (Markdown)."
    )
    parser.add_argument(
        "page", nargs="?", choices=list(_pages()), default=_FIRST, metavar="PAGE",
        help="without it: what pages there are",
    )  # fmt: skip
    return parser


def docs_command(argv: Sequence[str]) -> int:
    """Run `refine docs`."""
    page = docs_parser().parse_args(argv).page
    print(_pages()[page].read_text(encoding="utf-8"), end="")
    return 0


def _pages() -> dict[str, Traversable]:
    """By name: those of the clone that this file lies in, else those that the installation carries."""
    folder: Traversable = _CLONE if (_CLONE / f"{_FIRST}.md").exists() else resources.files("refine_docs")
    found = {page.name.removesuffix(".md"): page for page in folder.iterdir() if page.name.endswith(".md")}
    return dict(sorted(found.items()))
