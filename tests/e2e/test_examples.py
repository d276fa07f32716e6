"""The examples, run as they are against the whole server."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from sample import MESH, SAMPLE
from serve_process import Served, environment

from refine_engine import read_mesh

EXAMPLES = SAMPLE.parents[1]


def check_refined(content: bytes) -> None:
    """It is the sample's mesh with other vertices."""
    coarse, refined = read_mesh(MESH.read_bytes(), MESH.name).mesh, read_mesh(content, "refined.glb").mesh
    assert torch.equal(refined.faces, coarse.faces)
    assert not torch.allclose(refined.vertices, coarse.vertices, atol=1e-3)


@pytest.mark.skipif(shutil.which("curl") is None, reason="needs curl")
def test_one_curl_call(served: Served) -> None:
    command = [EXAMPLES / "submit.sh", SAMPLE]
    done = subprocess.run(
        command, env=environment({"server": served.url}), stdout=subprocess.PIPE, check=True
    )
    check_refined(done.stdout)


def test_the_sdk(served: Served, tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "sdk_refine.py"), str(SAMPLE), str(tmp_path)]
    done = subprocess.run(
        command, env=environment({"server": served.url}), stdout=subprocess.PIPE, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert lines[0].endswith(" queued")
    assert any(line.startswith("40/40  loss ") for line in lines)
    assert str(tmp_path / "report.json") in lines
    check_refined((tmp_path / "refined.glb").read_bytes())


def test_a_plain_stub(served: Served, tmp_path: Path) -> None:
    refined = tmp_path / "refined.glb"
    program = str(EXAMPLES / "grpc_refine.py")
    command = [sys.executable, program, served.grpc_address, str(SAMPLE), str(refined)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.splitlines()[-1].startswith("succeeded")
    check_refined(refined.read_bytes())
