"""The README's program, run as a reader runs it."""

import re
import subprocess
import sys
from pathlib import Path

from refine_engine import read_mesh

ROOT = Path(__file__).parents[2]


def test_the_program_runs(tmp_path: Path) -> None:
    (program,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(), re.M | re.S)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    subprocess.run([sys.executable, "-W", "error", "-c", program], cwd=tmp_path, check=True)
    refined = read_mesh((tmp_path / "refined.glb").read_bytes(), "refined.glb").mesh
    coarse = read_mesh((ROOT / "examples/samples/airplane/coarse.obj").read_bytes(), "coarse.obj").mesh
    assert refined.faces.shape == coarse.faces.shape
