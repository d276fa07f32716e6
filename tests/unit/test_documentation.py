"""What the documents promise: the README's program runs, the JSON of the documents is valid."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from refine_engine import camera_from_spec, read_camera, read_mesh

ROOT = Path(__file__).parents[2]


def blocks(document: str, language: str) -> list[str]:
    """The contents of the fenced code blocks of one language."""
    text = (ROOT / document).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_the_readme_program_runs(tmp_path: Path) -> None:
    (program,) = blocks("README.md", "python")
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    subprocess.run([sys.executable, "-W", "error", "-c", program], cwd=tmp_path, check=True)
    refined = read_mesh((tmp_path / "refined.glb").read_bytes(), "refined.glb").mesh
    coarse = read_mesh((ROOT / "examples/samples/airplane/coarse.obj").read_bytes(), "coarse.obj").mesh
    assert refined.faces.shape == coarse.faces.shape


@pytest.mark.parametrize("spec", blocks("README.md", "json") + blocks("docs/conventions.md", "json"))
def test_the_cameras_of_the_documents_are_cameras(spec: str) -> None:
    assert camera_from_spec(read_camera(spec.encode()), 640, 480).height == 480


@pytest.mark.parametrize("document", ["README.md", "CONTRIBUTING.md"])
def test_links_lead_somewhere(document: str) -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)\)", (ROOT / document).read_text())
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_scripts_named_in_the_readme_are_executable() -> None:
    named = re.findall(r"^(scripts/\w+)", "\n".join(blocks("README.md", "sh")), re.MULTILINE)
    assert named == ["scripts/demo", "scripts/test"]
    assert all((ROOT / script).stat().st_mode & 0o111 for script in named)
