"""Where the networks that people use put the camera of their input image, in the frame of their output.

Each row is what the project's own code says; docs/cameras.md names the places, and which networks know the
camera of the image and which only have a habit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

Vector = tuple[float, float, float]
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
MINUS_X, MINUS_Z = (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
BLENDER_FOV_DEGREES = 2 * math.degrees(math.atan(32 / 2 / 35))  # a lens of 35 mm before a sensor of 32 mm
PIXEL2MESH_FOV_DEGREES = 2 * math.degrees(math.atan(224 / 2 / 248))  # 248 pixels of an image of 224


class Network(StrEnum):
    """The networks whose frames are known."""

    TRIPOSR = "triposr"
    SF3D = "sf3d"
    INSTANTMESH = "instantmesh"
    TRELLIS = "trellis"
    HUNYUAN3D = "hunyuan3d"
    PIXEL2MESH = "pixel2mesh"
    OCCNET = "occnet"


@dataclass(frozen=True)
class Sphere:
    """Cameras that look at the origin of a network's frame."""

    front: Vector  # from the object to the camera at azimuth 0
    side: Vector  # and at azimuth 90
    up: Vector
    distance: float | None  # of the published camera; None: it differs from image to image
    fov_y_degrees: float

    def camera_to_world(self, azimuth: float, elevation: float, distance: float) -> list[list[float]]:
        """Three rows, OpenGL's axes; angles in degrees."""
        a, e = math.radians(azimuth), math.radians(elevation)
        level = _sum((math.cos(a), self.front), (math.sin(a), self.side))
        back = _sum((math.cos(e), level), (math.sin(e), self.up))
        right = _cross(self.up, level)
        upwards = _cross(back, right)
        return [[right[i], upwards[i], back[i], distance * back[i]] for i in range(3)]


SPHERES: Mapping[Network, Sphere] = {
    Network.TRIPOSR: Sphere(X, Y, Z, 1.9, 40.0),
    Network.SF3D: Sphere(MINUS_Z, MINUS_X, Y, 1.6, 40.0),
    Network.INSTANTMESH: Sphere(MINUS_Z, MINUS_X, Y, 4.0, 30.0),
    Network.TRELLIS: Sphere(Z, X, Y, 2.0, 40.0),
    Network.HUNYUAN3D: Sphere(Z, X, Y, None, BLENDER_FOV_DEGREES),
    Network.OCCNET: Sphere(X, Z, Y, None, BLENDER_FOV_DEGREES),
}
"""All but Pixel2Mesh, whose output is in the camera's own axes."""
DISTANCE_OF: Mapping[Network, str] = {
    Network.HUNYUAN3D: "1.26 times the diameter of the mesh's bounding sphere",
    Network.OCCNET: "1.75 times the one in rendering_metadata.txt, divided by the scale in pointcloud.npz",
}
"""What to give where no distance is published."""


def _sum(*terms: tuple[float, Vector]) -> Vector:
    x, y, z = (sum(factor * vector[i] for factor, vector in terms) for i in range(3))
    return x, y, z


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
