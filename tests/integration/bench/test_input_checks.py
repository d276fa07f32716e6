"""benchmarks/input_checks.py: one sample in all its mistakes, counted."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_a_sample_is_right_as_it_is_and_seen_wherever_a_mistake_shows(tmp_path: Path) -> None:
    (tmp_path / "car").symlink_to(ROOT / "examples" / "samples" / "car")
    script = ROOT / "benchmarks" / "input_checks.py"
    printed = subprocess.run(
        [sys.executable, script, "--verbose", tmp_path], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert printed[0] == "| what is wrong | cases | named | seen | cannot be seen | silent |"
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in printed[2:] if line.startswith("|")]
    assert rows[0] == ["nothing", "1", "0", "0", "1", "0"]
    assert {name for name, *_ in rows} > {"azimuth negated", "mesh 1000 times too large", "mask inverted"}
    for name, cases, named, seen, unseen, silent in rows[1:]:
        assert (cases, silent) == ("1", "0"), name
        assert int(named) <= int(seen) == 1 - int(unseen), name
    assert sum(int(named) for _, _, named, *_ in rows) >= 20
