"""A turntable: meshes side by side that turn once around the world's up axis, as an animated WebP."""

from __future__ import annotations

import io
from collections.abc import Mapping

from PIL import Image

from ..values import Camera, Mesh
from .pictures import PANEL_PIXELS, grid, hard_render, shade, side_camera

_STEP = 10  # degrees from frame to frame
_ELEVATION = 20.0  # degrees, of the camera
_FRAME_MS = 80
_QUALITY = 80  # of WebP, 0 to 100


def draw_turntable(meshes: Mapping[str, Mesh], framed: Mesh) -> bytes:
    """WebP, 36 frames that repeat: each mesh by its name, seen by a camera that sees all of `framed`."""
    frames = []
    for azimuth in range(0, 360, _STEP):
        # side_camera stands a quarter turn before the one it is given.
        before = Camera.look_at(azimuth + 90.0, _ELEVATION, 1.0, 60.0, 1, 1)
        camera = side_camera(before, framed, 2 * PANEL_PIXELS)
        panels = [(name, shade(mesh, camera, hard_render(mesh, camera))) for name, mesh in meshes.items()]
        frames.append(Image.fromarray(grid([panels])))
    stream = io.BytesIO()
    frames[0].save(
        stream,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=_FRAME_MS,
        loop=0,
        quality=_QUALITY,
    )
    return stream.getvalue()
