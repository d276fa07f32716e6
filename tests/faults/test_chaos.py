"""A short run of the chaos benchmark: nothing that was accepted is lost, doubled, stuck or broken."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_nothing_is_lost_whatever_is_killed_or_stopped() -> None:
    command = [sys.executable, str(ROOT / "benchmarks/chaos.py"), "--clients", "2", "--slots", "1"]
    command += ["--jobs", "12", "--seconds", "8", "--pause-s", "1", "--longest-stop-s", "1.5", "--seed", "4"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^[1-9]\d* jobs accepted in \d+ s, [1-9]\d* faults$", done.stdout, re.MULTILINE)
    assert "different refined.glb of the same job: 1\n" in done.stdout
    assert done.stdout.endswith("wrong: 0\n")
