"""One tiny refinement from files to artifacts, so that no job pays for imports, kernels or a device."""

from __future__ import annotations

import io

from PIL import Image, ImageDraw

from refine_engine.artifacts.make import make_artifacts
from refine_proto.models import LookAtCamera, RefinementOptions, RefinementSpec

from .refinery import Refinery, config_of, read_files

_ITERATIONS = 4  # at least one in every stage of the default preset
_OCTAHEDRON = b"""OFF
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


def warm_up(refinery: Refinery) -> None:
    """Refine an octahedron towards a disc."""
    image = Image.new("L", (64, 64))
    ImageDraw.Draw(image).ellipse((18, 18, 46, 46), fill=255)
    silhouette = io.BytesIO()
    image.save(silhouette, "PNG")
    spec = RefinementSpec(
        camera=LookAtCamera(azimuth_degrees=30, elevation_degrees=20, distance=1.6),
        options=RefinementOptions(iterations=_ITERATIONS),
    )
    config = config_of(spec)
    inputs = read_files(_OCTAHEDRON, silhouette.getvalue(), spec)
    result = refinery.optimise(inputs, config)
    make_artifacts(inputs.mesh_file, inputs.view, result, config)
