"""REFINE: test-time refinement of a coarse mesh from its silhouette and camera (arXiv 2108.09911).

`refine` is the method, on tensors. From files and back: `read_inputs`, `Inputs.refine`, `make_artifacts`.
"""

from .artifacts.make import make_artifacts
from .cameras.spec import camera_from_spec, read_camera
from .errors import Cancelled, Diverged, InputError, RefineError
from .files.mesh_file import MeshFile, read_mesh
from .files.silhouette import Silhouette, read_silhouette
from .method.config import RefineConfig
from .method.loop import refine
from .method.presets import make_config
from .request import Inputs, read_inputs, read_view
from .values import Camera, Mesh, Progress, Result, View

__all__ = [
    "Camera",
    "Cancelled",
    "Diverged",
    "InputError",
    "Inputs",
    "Mesh",
    "MeshFile",
    "Progress",
    "RefineConfig",
    "RefineError",
    "Result",
    "Silhouette",
    "View",
    "camera_from_spec",
    "make_artifacts",
    "make_config",
    "read_camera",
    "read_inputs",
    "read_mesh",
    "read_silhouette",
    "read_view",
    "refine",
]
