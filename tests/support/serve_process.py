"""`refine serve` as a user starts it: Redis, service and worker on free ports, and everyone it started."""

from __future__ import annotations

import os
import re
import subprocess
import sysconfig
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

REFINE = Path(sysconfig.get_path("scripts")) / "refine"


def environment(settings: Mapping[str, str]) -> dict[str, str]:
    """This environment with REFINE_* settings, given without the prefix, in the place of its own."""
    others = {name: value for name, value in os.environ.items() if not name.startswith("REFINE_")}
    return others | {f"REFINE_{name.upper()}": value for name, value in settings.items()}


@dataclass(frozen=True)
class Served:
    """A running `refine serve` and what it printed until it was ready."""

    process: subprocess.Popen[str]
    lines: list[str]

    @property
    def url(self) -> str:
        """Of REST."""
        return self._found(r"REST +(http://\S+)")

    @property
    def grpc_address(self) -> str:
        """host:port."""
        return self._found(r"gRPC +(\S+)")

    def _found(self, pattern: str) -> str:
        found = re.search(pattern, "".join(self.lines))
        assert found, self.lines
        return found[1]

    def family(self) -> list[psutil.Process]:
        """Every process below it."""
        return psutil.Process(self.process.pid).children(recursive=True)


@contextmanager
def serve(folder: Path, settings: Mapping[str, str] | None = None) -> Iterator[Served]:
    """Ready, with one slot on the CPU, or ended; killed at the end if it still runs."""
    process = subprocess.Popen(
        [
            *(REFINE, "serve", "--data-folder", folder, "--http-port", "0", "--grpc-port", "0"),
            *("--devices", "cpu", "--slots-per-device", "1"),
        ],
        env=environment(settings or {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("ready"):
                break
        yield Served(process, lines)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()
