"""How a command ends: its exit code, and an error as one line on standard error."""

from __future__ import annotations

import argparse
import sys
from typing import NoReturn

from ..errors import InvalidInput

FAILED = 1
"""The job, the server or the program failed; the input may be good."""
BAD_INPUT = 2
"""Running it again will not help."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are InvalidInput, told like every other error."""

    def error(self, message: str) -> NoReturn:
        """Raise InvalidInput."""
        raise InvalidInput(f"{message}; {self.prog} --help explains the arguments")


def fail(message: str, code: int) -> int:
    """Print `error: message` as one line without control characters, whatever is in it; returns the code."""
    line = " ".join("".join(c if c.isprintable() else " " for c in message).split())
    print(f"error: {line}", file=sys.stderr)
    return code
