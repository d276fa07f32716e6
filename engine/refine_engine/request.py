"""The bytes of a request -> what `refine` takes, with every check that is possible before it starts."""

from __future__ import annotations

from dataclasses import dataclass

from refine_proto.cameras import CameraSpec
from refine_proto.formats import SILHOUETTE_THRESHOLD

from .cameras.in_view import check_in_view
from .cameras.spec import camera_from_spec
from .files.limits import MeshLimits
from .files.mesh_file import MeshFile, read_mesh
from .files.png import read_silhouette
from .values import View


@dataclass(frozen=True)
class Inputs:
    """One request, read and checked."""

    mesh_file: MeshFile  # with warnings of its own
    view: View
    warnings: tuple[str, ...]  # about the mesh, the silhouette and the camera together


def read_inputs(
    mesh: bytes,
    mesh_name: str,
    silhouette: bytes,
    camera: CameraSpec,
    silhouette_threshold: float = SILHOUETTE_THRESHOLD,
    limits: MeshLimits = MeshLimits(),
) -> Inputs:
    """Read a mesh file and a silhouette image, for a camera as `read_camera` gives it.

    `mesh_name` matters for its suffix where the bytes do not tell the format. Raises an InputError: the mesh,
    the silhouette or the camera is invalid, or the camera does not see the mesh.
    """
    mesh_file = read_mesh(mesh, mesh_name, limits)
    view = read_view(silhouette, camera, silhouette_threshold)
    warning = check_in_view(mesh_file.mesh, view, camera)
    return Inputs(mesh_file, view, (warning,) if warning else ())


def read_view(silhouette: bytes, camera: CameraSpec, threshold: float = SILHOUETTE_THRESHOLD) -> View:
    """A silhouette image and the camera that saw it; raises SilhouetteInvalid or CameraInvalid."""
    coverage = read_silhouette(silhouette, threshold)
    height, width = coverage.shape
    return View(coverage, camera_from_spec(camera, width, height))
