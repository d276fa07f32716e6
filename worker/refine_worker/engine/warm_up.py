"""Tiny refinements from files to artifacts, so that no job pays for imports, kernels or a device."""

from __future__ import annotations

import io

import torch
from PIL import Image, ImageDraw

from refine_engine.artifacts.make import make_artifacts
from refine_engine.kernels.graph import EAGER_RUNS
from refine_engine.method.presets import make_config
from refine_engine.request import read_inputs
from refine_proto.cameras import LookAtCamera

_ITERATIONS = EAGER_RUNS + 1  # so that one is recorded on a card
OCTAHEDRON = b"""OFF
6 8 0
0.4 0 0
-0.4 0 0
0 0.4 0
0 -0.4 0
0 0 0.4
0 0 -0.4
3 0 2 4
3 2 1 4
3 1 3 4
3 3 0 4
3 2 0 5
3 1 2 5
3 3 1 5
3 0 3 5
"""


def presets_to_warm(device: torch.device) -> list[str]:
    """Those that do something that no other does: `paper` trains the encoder.

    On a card its convolutions have to be planned. On a CPU its first iterations are as quick as later ones.
    """
    return ["default", "paper"] if device.type == "cuda" else ["default"]


def warm_up(device: torch.device, preset: str) -> None:
    """Refine an octahedron towards a disc."""
    image = Image.new("L", (64, 64))
    ImageDraw.Draw(image).ellipse((18, 18, 46, 46), fill=255)
    silhouette = io.BytesIO()
    image.save(silhouette, "PNG")
    camera = LookAtCamera(azimuth_degrees=30, elevation_degrees=20, distance=1.6)
    inputs = read_inputs(OCTAHEDRON, "octahedron.off", silhouette.getvalue(), camera)
    config = make_config(preset, _ITERATIONS)
    make_artifacts(inputs, inputs.refine(config, device), config)
