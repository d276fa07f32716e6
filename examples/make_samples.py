"""Make the sample cases in examples/samples: our own objects, so with ground truth and under our licence.

    python examples/make_samples.py                 write every sample beside this script
    python examples/make_samples.py -o DIR airplane write some samples elsewhere

Each sample is a folder: `gt.obj` (ground truth), `coarse.obj` (what a reconstruction network would give),
`silhouette.png` (RGBA, the object in alpha) and `camera.json` (a look_at CameraSpec).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from refine_bench.coarsen import coarsen
from refine_bench.shapes import make_shape
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.values import Camera, Mesh

SIZE = 224  # pixels, the method's image size
SAMPLES_FOLDER = Path(__file__).resolve().parent / "samples"


@dataclass(frozen=True)
class LookAt:
    """The `look_at` camera as it stands in camera.json."""

    azimuth_degrees: float
    elevation_degrees: float
    distance: float
    fov_y_degrees: float = 60.0


@dataclass(frozen=True)
class Sample:
    """What makes a sample: its category, the seeds of its shape and of its errors, and its camera."""

    category: str
    shape_seed: int
    coarse_seed: int
    camera: LookAt


SAMPLES = {
    "airplane": Sample("airplane", 0, 8, LookAt(52.0, 28.0, 1.3)),
    "car": Sample("car", 1, 1, LookAt(40.0, 16.0, 1.5)),
    "chair": Sample("chair", 2, 7, LookAt(62.0, 20.0, 1.6)),
    "desk": Sample("desk", 3, 3, LookAt(118.0, 24.0, 1.7)),
    "mug": Sample("mug", 4, 4, LookAt(24.0, 30.0, 1.75)),
    "table": Sample("table", 5, 5, LookAt(145.0, 35.0, 1.55)),
}


def write_obj(path: Path, shape: trimesh.Trimesh) -> None:
    """Positions to five decimals: 1e-5 of the longest side, far below what the metrics resolve."""
    vertices = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in shape.vertices]
    faces = [f"f {a} {b} {c}" for a, b, c in shape.faces + 1]
    path.write_text("\n".join([*vertices, *faces]) + "\n", encoding="ascii")


def make_sample(sample: Sample, folder: Path) -> None:
    """Write the four files of a sample."""
    folder.mkdir(parents=True, exist_ok=True)
    shape = make_shape(sample.category, sample.shape_seed)
    camera = Camera.look_at(**asdict(sample.camera), width=SIZE, height=SIZE)
    mesh = Mesh(
        torch.tensor(shape.vertices, dtype=torch.float32), torch.tensor(shape.faces, dtype=torch.int64)
    )
    mask = hard_silhouette(mesh, camera).numpy().astype(np.uint8) * 255
    write_obj(folder / "gt.obj", shape)
    write_obj(folder / "coarse.obj", coarsen(shape, sample.coarse_seed))
    Image.fromarray(np.stack([mask] * 4, -1)).save(folder / "silhouette.png", optimize=True)
    spec = {"type": "look_at", **asdict(sample.camera)}
    (folder / "camera.json").write_text(json.dumps(spec, indent=2) + "\n", encoding="ascii")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Make the sample cases.")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"samples to make: {', '.join(SAMPLES)} (default: all)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=SAMPLES_FOLDER, metavar="DIR", help="where to write them"
    )
    arguments = parser.parse_args(argv)
    for name in arguments.names or SAMPLES:
        if name not in SAMPLES:
            parser.error(f"expected names among {', '.join(SAMPLES)}, got {name!r}")
        make_sample(SAMPLES[name], arguments.output / name)
        print(arguments.output / name)


if __name__ == "__main__":
    main()
