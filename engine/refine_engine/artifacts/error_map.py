"""Error maps for people: how far a mesh is from its ground truth, and what of the truth it lacks."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..files.colour_scale import confidence_colours
from ..kernels import interpolate
from ..method.symmetry import surface_points
from ..values import Camera, Mesh, View
from .pictures import PANEL_PIXELS, Picture, encode, fit, grid, hard_render, legend, side_camera

WORST = 0.05  # sides of the ground truth's box: the end of the colour scale, twice the F-score's threshold
_POINTS = 400_000  # of a surface: a fifth of a per cent of the object apart
_AROUND = 120.0, 20.0  # degrees: without a camera the first look is a quarter turn before this, from above


class Surface:
    """A mesh that distances are measured to."""

    def __init__(self, mesh: Mesh) -> None:
        self._tree = cKDTree(surface_points(mesh, _POINTS).numpy())

    def error_picture(self, mesh: Mesh, camera: Camera, scale: float) -> Picture:
        """RGB (H, W, 3) of what the camera sees of `mesh`: how far every pixel's point is from here.

        In the colours of `colour_scale`, from 0 to `scale` (world units) and more. White around.
        """
        fragments = hard_render(mesh, camera)
        faces, vertices = mesh.faces.cpu(), mesh.vertices.detach().cpu()
        axes = [interpolate(fragments, faces, vertices[:, axis])[0].numpy() for axis in range(3)]
        covered = (fragments.face[0] >= 0).numpy()
        picture = np.full((*covered.shape, 3), 255, np.uint8)
        distance, _ = self._tree.query(np.stack(axes, -1)[covered])
        picture[covered] = (confidence_colours(distance / scale) * 255 + 0.5).astype(np.uint8)
        return picture


def longest_side(mesh: Mesh) -> float:
    """Of the box around its triangles, world units."""
    used = mesh.vertices[mesh.faces.flatten()]
    return float((used.amax(0) - used.amin(0)).max())


def draw_errors(meshes: dict[str, Mesh], truth: Mesh, view: View | None = None) -> bytes:
    """PNG, a row for each mesh by its name: how far it is from the truth, and how far the truth is from it.

    Both as the view's camera sees them (without a view: from the front, above), and a quarter turn around.
    """
    pixels = 2 * PANEL_PIXELS
    around = view.camera if view else Camera.look_at(*_AROUND, 1.0, 60.0, pixels, pixels)
    side = side_camera(around, truth, pixels)
    front = fit(view.camera, pixels) if view else side
    second = side if view else side_camera(side, truth, pixels)
    surface, scale = Surface(truth), WORST * longest_side(truth)
    rows = []
    for name, mesh in meshes.items():
        lacks = Surface(mesh)
        rows.append(
            [
                (f"{name}: error", surface.error_picture(mesh, front, scale)),
                (f"{name}: error, from the side", surface.error_picture(mesh, second, scale)),
                (f"truth: what {name} lacks", lacks.error_picture(truth, front, scale)),
                ("the same, from the side", lacks.error_picture(truth, second, scale)),
            ]
        )
    sheet = grid(rows)
    words = ("0: on the surface", f"{100 * WORST:g} % of the truth's longest side, and more")
    return encode(np.concatenate([sheet, legend(sheet.shape[1], *words)[..., :3]]))
