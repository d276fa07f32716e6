"""The program of docs/sdk.md and the example run; what the page shows of Python compiles."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from inspect import Parameter, signature
from pathlib import Path

import pytest
from server_double import ARTIFACTS, Script

from refine_client import AsyncRefineClient, RefineClient

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/sdk.md").read_text()
SAMPLE = ROOT / "examples/samples/airplane"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("program", [*blocks("python"), (ROOT / "examples/sdk_refine.py").read_text()])
def test_the_programs_run(program: str, server: str, script: Script, tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "program.py").write_text(program)
    answer = subprocess.run(
        [sys.executable, "-W", "error", "program.py", *([str(SAMPLE)] if "argv" in program else [])],
        cwd=tmp_path,
        env={**os.environ, "REFINE_SERVER": server},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "out/refined.glb" in answer.stdout
    assert (tmp_path / "out/refined.glb").read_bytes() == ARTIFACTS["refined.glb"]
    (upload,) = script.uploads.values()
    assert upload["mesh"] == (SAMPLE / "coarse.obj").read_bytes()


@pytest.mark.parametrize("fragment", blocks("py"))
def test_the_fragments_are_python(fragment: str) -> None:
    compile(fragment, "docs/sdk.md", "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)


def test_the_table_has_every_method_and_its_arguments() -> None:
    for name, method in vars(RefineClient).items():
        if name.startswith("_") or name == "close":
            continue
        assert f"`{name}(" in PAGE, name
        described = PAGE.partition(f"`{name}(")[2].partition(")`")[0]
        for parameter in list(signature(method).parameters.values())[1:]:
            wanted = "id" if parameter.name == "refinement_id" else parameter.name
            assert re.search(rf"\b{wanted}\b", described), (name, wanted)


def test_both_clients_have_the_same_methods() -> None:
    def shape(client: type) -> dict[str, list[tuple[str, object, object]]]:
        return {
            name: [(p.name, p.kind, p.default) for p in signature(method).parameters.values()]
            for name, method in vars(client).items()
            if callable(method) and (not name.startswith("_") or name == "__init__")
        }

    assert shape(RefineClient) == shape(AsyncRefineClient)
    assert Parameter.empty not in [p.annotation for p in signature(RefineClient).parameters.values()]
