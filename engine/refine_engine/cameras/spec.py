"""The contract's CameraSpec -> Camera, the one internal form. What else its numbers could mean: readings.py.

What a CameraSpec may be, and what is wrong with one, is said in `refine_proto.cameras`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import ValidationError
from torch import Tensor

from refine_proto.cameras import (
    CAMERA_SPEC,
    DEFAULT_FOV_Y_DEGREES,
    CameraSpec,
    EstimatedCamera,
    Intrinsics,
    LookAtCamera,
    MatrixCamera,
)
from refine_proto.strict import complaints, in_one_line

from ..errors import CameraInvalid
from ..values import Camera, focal_length

Convention = Literal["opencv", "opengl", "pytorch3d"]
Direction = Literal["world_to_camera", "camera_to_world"]
DIRECTIONS: tuple[Direction, Direction] = ("world_to_camera", "camera_to_world")

# The camera axes of each convention in OpenCV's (+X right, +Y down, +Z forward), as the diagonal of a flip.
AXES: Mapping[Convention, tuple[float, float, float, float]] = {
    "opencv": (1.0, 1.0, 1.0, 1.0),
    "opengl": (1.0, -1.0, -1.0, 1.0),  # +X right, +Y up, -Z forward: Blender, glTF
    "pytorch3d": (-1.0, -1.0, 1.0, 1.0),  # +X left, +Y up, +Z forward
}


def read_camera(camera: bytes | Mapping[str, object]) -> CameraSpec:
    """The camera in a JSON file, or in the object that was in one; raises CameraInvalid."""
    try:
        if isinstance(camera, bytes):
            return CAMERA_SPEC.validate_json(camera)
        return CAMERA_SPEC.validate_python(camera)
    except ValidationError as error:
        raise CameraInvalid(in_one_line(complaints(error.errors(), under=("camera",)))) from None


def camera_from_spec(spec: CameraSpec, width: int, height: int) -> Camera:
    """The camera that `spec` describes, for an image of `width` x `height` pixels.

    Raises CameraInvalid for intrinsics that belong to another size of image, and for a camera that is to be
    estimated, which takes the mesh.
    """
    if isinstance(spec, EstimatedCamera):
        raise CameraInvalid("expected a camera that is known, got type estimate; estimate it first")
    if isinstance(spec, LookAtCamera):
        pose = look_at_pose(spec, spec.azimuth_degrees, spec.elevation_degrees)
        f = _focal_length(spec, width, height)
        return Camera(pose, f, f, width / 2, height / 2, width, height)
    pose = WrittenPose.of(spec).world_to_camera()
    return Camera(pose, *_lens(spec, width, height), width, height, spec.projection)


def spec_of(camera: Camera) -> MatrixCamera:
    """A camera as a caller gives one."""
    return MatrixCamera(
        convention="opencv",
        world_to_camera=camera.world_to_camera.tolist(),
        intrinsics=Intrinsics(
            fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, width=camera.width, height=camera.height
        ),
        projection=camera.projection,
    )


@dataclass(frozen=True)
class WrittenPose:
    """A rigid 4x4 matrix and what it is taken to mean."""

    matrix: Tensor  # (4, 4) float64
    convention: Convention
    direction: Direction
    transposed: bool = False  # the rotation acts on row vectors, as PyTorch3D's R does

    @staticmethod
    def of(spec: MatrixCamera) -> WrittenPose:
        direction: Direction = "camera_to_world" if spec.world_to_camera is None else "world_to_camera"
        return WrittenPose(
            torch.tensor(getattr(spec, direction), dtype=torch.float64), spec.convention, direction
        )

    def world_to_camera(self) -> Tensor:
        """(4, 4) float32 in OpenCV's axes."""
        matrix = self.matrix.clone()
        if self.transposed:
            matrix[:3, :3] = self.matrix[:3, :3].T
        if self.direction == "camera_to_world":
            matrix = torch.linalg.inv(matrix)
        return (torch.tensor(AXES[self.convention], dtype=torch.float64)[:, None] * matrix).float()

    def describe(self) -> str:
        rotation = " with the rotation transposed" if self.transposed else ""
        return f"convention {self.convention}, {self.direction}{rotation}"


def look_at_pose(spec: LookAtCamera, azimuth: float, elevation: float) -> Tensor:
    """(4, 4): the camera of `spec` with other angles, its roll as it is."""
    pose = Camera.look_at(azimuth, elevation, spec.distance, DEFAULT_FOV_Y_DEGREES, 1, 1).world_to_camera
    roll = math.radians(spec.roll_degrees)
    if roll == 0.0:
        return pose
    cos, sin = math.cos(roll), math.sin(roll)
    turn = torch.eye(4)
    turn[0, 0], turn[0, 1], turn[1, 0], turn[1, 1] = cos, sin, -sin, cos
    return turn @ pose


def _focal_length(spec: LookAtCamera | MatrixCamera, width: int, height: int) -> float:
    """Pixels, from the one field of view that is given."""
    if spec.fov_x_degrees is not None:
        return focal_length(spec.fov_x_degrees, width)
    assert spec.fov_y_degrees is not None
    return focal_length(spec.fov_y_degrees, height)


def _lens(spec: MatrixCamera, width: int, height: int) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels."""
    lens = spec.intrinsics
    if lens is None:
        f = _focal_length(spec, width, height)
        return f, f, width / 2, height / 2
    try:
        lens.check_size(width, height)
    except ValueError as error:
        raise CameraInvalid(str(error)) from None
    return lens.fx, lens.fy, lens.cx, lens.cy
