"""The script behind the tables gives commands that `refine bench` understands, each its own folder."""

import os
import shlex
import subprocess
from pathlib import Path

from refine_bench.options import bench_parser

SCRIPT = Path(__file__).resolve().parents[3] / "benchmarks" / "evidence"
RECORDER = """#!/usr/bin/env bash
printf '%q ' "$@" >>"$COMMANDS"
echo >>"$COMMANDS"
while [ "$1" != -o ]; do shift; done
mkdir -p "$2"
echo tables >"$2/tables.md"
case "$2" in *families) exit 1 ;; esac
"""


def test_every_command_is_one_of_refine_bench_and_a_failure_stops_nothing(tmp_path: Path) -> None:
    recorder = tmp_path / "bin" / "refine"
    recorder.parent.mkdir()
    recorder.write_text(RECORDER)
    recorder.chmod(0o755)
    for name in ("cases", "real"):
        (tmp_path / "shared" / name).mkdir(parents=True)
    commands = tmp_path / "commands"
    environment = os.environ | {
        "PATH": f"{recorder.parent}{os.pathsep}{os.environ['PATH']}",
        "COMMANDS": str(commands),
    }
    out = tmp_path / "out"
    ran = subprocess.run([SCRIPT, out, tmp_path / "shared"], env=environment, capture_output=True, text=True)
    assert ran.returncode == 1  # one could not measure all its cases
    lines = [shlex.split(line) for line in commands.read_text().splitlines()]
    assert [line.pop(0) for line in lines] == ["bench"] * len(lines)
    options = [bench_parser().parse_args(line) for line in lines]
    folders = [each.output for each in options]
    assert len(set(folders)) == len(folders) > 15
    assert {each.set for each in options} == {"upstream", "families", "synthetic", "folder"}
    assert (out / "tables.md").read_text() == "tables\n" * len(lines)
