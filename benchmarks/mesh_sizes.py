"""What meshes of 1,500 to 500,000 vertices cost, and whether they get as good, as a Markdown table.

    python benchmarks/mesh_sizes.py examples/samples/chair

The coarse mesh of a case is subdivided, so that all sizes have one surface and one truth. Every size runs in
a process of its own: read a GLB, refine it with the default, make the artifacts. Times are of one thread.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from refine_bench import measure
from refine_engine.artifacts.make import make_artifacts
from refine_engine.cameras.spec import read_camera
from refine_engine.files.materials import MATTE
from refine_engine.files.polygons import mesh_document
from refine_engine.method.config import RefineConfig
from refine_engine.request import read_inputs
from refine_engine.scores.scores import evaluate
from refine_engine.values import Mesh

LEVELS = (0, 1, 2, 3, 4)  # times 4 each: 1,500 to 384,000 vertices
SCORE_SEEDS = range(3)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "case", type=Path, help="a folder with coarse.obj, silhouette.png, camera.json, gt.obj"
    )
    parser.add_argument("--mesh", type=Path, help=argparse.SUPPRESS)  # one size, in its own process
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    if options.mesh:
        print(json.dumps(one_size(options.case, options.mesh)))
        return
    coarse = measure.read_mesh_file(options.case / "coarse.obj")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for level in (LEVELS[0], *LEVELS):  # the first compiles, and does not count
            path = Path(folder) / f"{level}.glb"
            path.write_bytes(glb(subdivided(coarse, level)))
            command = [sys.executable, __file__, str(options.case), "--mesh", str(path)]
            run = subprocess.run(command, check=True, capture_output=True, text=True)
            rows.append(json.loads(run.stdout))
    show(rows[1:])


def one_size(case: Path, path: Path) -> dict[str, Any]:
    """Seconds, peak memory and scores of one run."""
    config, started = RefineConfig(), time.monotonic()
    seconds: dict[str, float] = {}

    def lap(stage: str) -> None:
        nonlocal started
        seconds[stage] = time.monotonic() - started
        started = time.monotonic()

    camera = read_camera((case / "camera.json").read_bytes())
    inputs = read_inputs(path.read_bytes(), path.name, (case / "silhouette.png").read_bytes(), camera)
    lap("read")
    result = inputs.refine(config)
    lap("refine")
    make_artifacts(inputs, result, config)
    lap("artifacts")
    memory = measure.peak_memory_bytes()
    truth = case / "gt.obj"
    chamfer: list[float | None] = [None, None]
    if truth.exists():
        meshes = (inputs.mesh_file.mesh, result.mesh)
        true_mesh = measure.read_mesh_file(truth)
        chamfer = [evaluate(mesh, true_mesh, seeds=SCORE_SEEDS).chamfer_l2 for mesh in meshes]
    proxy = result.proxy
    return {
        "vertices": len(inputs.mesh_file.mesh.vertices),
        "optimised": proxy.vertices if proxy else len(inputs.mesh_file.mesh.vertices),
        **seconds,
        "memory": memory,
        "iou": result.silhouette_iou_after,
        "proxy_iou": proxy.silhouette_iou_after if proxy else None,
        "chamfer": chamfer,
    }


def show(rows: Sequence[dict[str, Any]]) -> None:
    first = rows[0]["refine"]
    print("| vertices | optimised | read, s | refine, s | times the first | artifacts, s | peak memory, GB | "
          "2D IoU | of the proxy | Chamfer-l2 ratio |")  # fmt: skip
    print("|---:" * 10 + "|")
    for row in rows:
        before, after = row["chamfer"]
        cells = [
            *(f"{row[name]:,}" for name in ("vertices", "optimised")),
            *(f"{row['read']:.1f}", f"{row['refine']:.1f}", f"{row['refine'] / first:.2f}"),
            *(f"{row['artifacts']:.1f}", f"{row['memory'] / 1e9:.1f}", f"{row['iou']:.3f}"),
            "" if row["proxy_iou"] is None else f"{row['proxy_iou']:.3f}",
            "" if before is None else f"{after / before:.3f}",
        ]
        print("| " + " | ".join(cells) + " |")


def subdivided(mesh: Mesh, levels: int) -> Mesh:
    """Every edge halved so often."""
    vertices, faces = mesh.vertices.double(), mesh.faces
    for _ in range(levels):
        sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(1).values
        edges, middle = sides.unique(dim=0, return_inverse=True)
        ab, bc, ca = (middle.reshape(-1, 3) + len(vertices)).unbind(1)
        vertices = torch.cat([vertices, vertices[edges].mean(1)])
        a, b, c = faces.unbind(1)
        pieces = ((a, ab, ca), (ab, b, bc), (bc, c, ca), (ab, bc, ca))
        faces = torch.cat([torch.stack(corners, 1) for corners in pieces])
    return replace(mesh, vertices=vertices.float(), faces=faces)


def glb(mesh: Mesh) -> bytes:
    part = {
        "POSITION": mesh.vertices.numpy().astype("<f4"),
        "TEXCOORD_0": mesh.vertices.numpy()[:, :2].astype("<f4"),
        "faces": mesh.faces.numpy().astype(np.int64),
    }
    return mesh_document([(part, MATTE)]).to_glb()


if __name__ == "__main__":
    main()
