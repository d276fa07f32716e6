"""What the documents promise: their JSON is valid, their links and scripts are there."""

import re
from pathlib import Path

import pytest

from refine_engine import camera_from_spec, read_camera

ROOT = Path(__file__).parents[2]


def blocks(document: str, language: str) -> list[str]:
    """The contents of the fenced code blocks of one language."""
    text = (ROOT / document).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


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
