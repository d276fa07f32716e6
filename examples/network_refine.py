"""From an image to a refined mesh, all in this checkout: photo, reconstruction network, REFINE.

python examples/network_refine.py [KIND [OUTPUT_FOLDER]]
KIND is what is photographed, such as bench, car, chair or sofa (all of `refine_bench.shapes`). The network
was trained without benches, cars and lamps. Needed: pip install '.[bench]'. Under a minute.
"""

from __future__ import annotations

import sys
from pathlib import Path

from refine_bench.export import export_case
from refine_bench.sets.upstream import Instance, case_of
from refine_bench.upstream.photos import HELD_OUT
from refine_engine import make_artifacts, make_config, read_camera, read_inputs, read_mesh
from refine_engine.scores.scores import evaluate


def main(kind: str, output: Path) -> None:
    level = "strong" if kind in HELD_OUT else "none"
    folder = export_case(case_of(Instance(kind, 0, level, seed=0)), output)
    print(f"{folder}: the photo image.png, and coarse.obj, which the network made of it")

    mesh, silhouette = (folder / name for name in ("coarse.obj", "silhouette.png"))
    camera = read_camera((folder / "camera.json").read_bytes())
    inputs = read_inputs(mesh.read_bytes(), mesh.name, silhouette.read_bytes(), camera)
    config = make_config("fast")
    result = inputs.refine(config)
    for name, data in make_artifacts(inputs, result, config).items():
        (folder / name).write_bytes(data)

    truth = read_mesh((folder / "gt.obj").read_bytes(), "gt.obj").mesh
    for name, predicted in (("coarse", inputs.mesh_file.mesh), ("refined", result.mesh)):
        scores = evaluate(predicted, truth, seeds=[0], view=inputs.views[0])
        print(
            f"{name:8} Chamfer-l2 {scores.chamfer_l2:6.2f}  F-score {scores.f_score:5.1f}  "
            f"2D IoU {scores.silhouette_iou:.3f}"
        )
    print(f"{folder / 'preview.png'} shows both, from the camera and from the side")


if __name__ == "__main__":
    chosen = sys.argv[1] if len(sys.argv) > 1 else "car"
    main(chosen, Path(sys.argv[2] if len(sys.argv) > 2 else "out"))
