"""A short run of the fuzzer: every changed mesh file is read and written again, or refused by name."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def test_changed_files_are_read_or_refused(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "benchmarks/fuzz.py"), "--inputs", "3000", "--slow-s", "inf"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("3000 inputs")
    assert " read\n" in done.stdout
    assert "MESH_INVALID" in done.stdout
