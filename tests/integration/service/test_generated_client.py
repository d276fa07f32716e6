"""A client that a generator makes of /openapi.json submits both kinds of body and reads the answers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from service_process import MESH, PNG, Service

pytest.importorskip("openapi_python_client", reason="the generator is not installed: pip install '.[dev]'")

PROGRAM = """
import base64, io, sys
from generated import Client
from generated.api.refinements import cancel_refinement, create_refinement, get_refinement, list_refinements
from generated.models import CreateRefinementFilesBody, LookAtCamera, Metadata, MeshFormat, Preset, Refinement
from generated.models import RefinementOptions, RefinementRequest, State
from generated.types import File

server, mesh, silhouette = sys.argv[1], open(sys.argv[2], "rb").read(), open(sys.argv[3], "rb").read()
camera = LookAtCamera(type_="look_at", azimuth_degrees=30, elevation_degrees=10, distance=2)
options = RefinementOptions(preset=Preset.FAST, iterations=20)
as_files = CreateRefinementFilesBody(
    mesh=File(io.BytesIO(mesh), "coarse.obj"),
    silhouette=File(io.BytesIO(silhouette), "silhouette.png"),
    camera=camera,
    options=options,
    metadata=Metadata.from_dict({"set": "chairs"}),
)
as_json = RefinementRequest(
    mesh=base64.b64encode(mesh).decode(),
    silhouette=base64.b64encode(silhouette).decode(),
    mesh_format=MeshFormat.OBJ,
    camera=camera,
    options=options,
)
with Client(base_url=server) as client:
    for body in (as_files, as_json):
        sent = create_refinement.sync(client=client, body=body)
        assert isinstance(sent, Refinement), sent
        found = get_refinement.sync(sent.id, client=client)
        assert found.state is State.QUEUED
        assert (found.options.preset, found.options.iterations) == (Preset.FAST, 20)
    assert [r.id for r in list_refinements.sync(client=client, limit=1).refinements] == [sent.id]
    assert cancel_refinement.sync(sent.id, client=client).state is State.CANCELLED
"""


def test_a_generated_client_submits(service: Service, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("package_name_override: generated\npost_hooks: []\n")
    generate = [
        sys.executable,
        "-m",
        "openapi_python_client",
        "generate",
        "--meta",
        "none",
        "--fail-on-warning",
        "--url",
        f"{service.rest_url}/openapi.json",
        "--config",
        "config.yaml",
        "--output-path",
        "generated",
    ]
    made = subprocess.run(generate, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout + made.stderr
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "mesh").write_bytes(MESH)
    (tmp_path / "silhouette").write_bytes(PNG)
    run = [sys.executable, "program.py", service.rest_url, "mesh", "silhouette"]
    ran = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
