"""Files stream from and to the disk: a client does not grow with them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from server_double import ARTIFACTS, Script

SIZE = 60_000_000
PROGRAM = """
import asyncio, inspect, resource, sys
import refine_client

server, mesh, silhouette, output, face = sys.argv[1:]
camera = {"type": "look_at", "azimuth_degrees": 0, "elevation_degrees": 0, "distance": 2}
unit = 1 if sys.platform == "darwin" else 1024

def used():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit

async def main():
    client = getattr(refine_client, face)(server)
    async def call(result):
        return await result if inspect.isawaitable(result) else result
    await call(client.get("job-1"))
    await call(client.submit(silhouette, silhouette, camera))
    before = used()
    await call(client.submit(mesh, silhouette, camera, idempotency_key="large-one"))
    await call(client.download("job-1", output, ["large.bin"]))
    print(used() - before)
    await call(client.close())

asyncio.run(main())
"""


@pytest.mark.parametrize("face", ["RefineClient", "AsyncRefineClient"])
def test_60_mb_up_and_down(
    server: str, script: Script, silhouette: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, face: str
) -> None:
    content = bytes(range(250)) * (SIZE // 250)
    monkeypatch.setitem(ARTIFACTS, "large.bin", content)
    mesh = tmp_path / "large.obj"
    mesh.write_bytes(content)
    command = [sys.executable, "-c", PROGRAM, server, str(mesh), str(silhouette), str(tmp_path / "out"), face]
    grown = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    upload = script.uploads["large-one"]
    assert upload["mesh"] == content
    assert (tmp_path / "out/large.bin").read_bytes() == content
    assert grown < 20_000_000
    if server.startswith("grpc"):
        assert max(upload["chunks"]) == 64 * 1024
        assert upload["announced"] == (SIZE, silhouette.stat().st_size)
