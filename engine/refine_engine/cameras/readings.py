"""What else the numbers of a camera could mean: every usual way to write one down wrongly, undone.

A mistake is about the pose (a sign, a quarter turn, a convention, a direction, an up axis, radians), the lens
(intrinsics of another image, of none, an angle of the other side) or the unit of length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from refine_proto.cameras import CameraSpec, LookAtCamera, MatrixCamera

from ..values import Camera, focal_length
from .spec import AXES, DIRECTIONS, WrittenPose, look_at_pose

UNITS = (10.0, 100.0, 1000.0)  # millimetres, centimetres and metres in any two places
LARGEST_NORMALISED = 10.0  # fx in widths of the image; in pixels it is larger
SENSOR_MM = 36.0  # the longest side of a 35 mm picture, which Blender's lenses are told for
SAME = 1e-4  # relative: cameras this near see the same

_FLIP_X = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))
_FLIP_Y = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))
_Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # x, y, z -> x, z, -y


def other_readings(spec: CameraSpec, given: Camera) -> dict[str, Camera]:
    """What the numbers of `spec`, which says `given`, mean otherwise: description -> camera, likelier first.

    Readings that are the same camera as the given one or as an earlier one are left out.
    """
    readings = [*_angles(given), *_world(given), *_units(given), *_lens(spec, given)]
    if isinstance(spec, LookAtCamera):
        readings = [*readings, *_radians(spec, given)]
    if isinstance(spec, MatrixCamera):
        readings = [*_matrices(spec, given), *readings]
    found: dict[str, Camera] = {}
    for name, camera in readings:
        if not any(_same(camera, other) for other in (given, *found.values())):
            found[name] = camera
    return found


def _angles(given: Camera) -> Iterator[tuple[str, Camera]]:
    """Angles counted the other way, or from another axis. Of a matrix: of the place that it stands for."""
    pose = given.world_to_camera.cpu()
    mirrored = _FLIP_X @ pose @ _FLIP_X  # the azimuth negated
    yield "azimuth negated", _posed(given, mirrored)
    yield "elevation negated", _posed(given, _FLIP_Y @ pose @ _FLIP_Y)
    yield "azimuth and elevation negated", _posed(given, _FLIP_Y @ mirrored @ _FLIP_Y)
    for turn in (90, -90, 180):
        yield f"azimuth {turn:+}", _posed(given, pose @ _turn(-turn))
    for start in (90, -90, 180):
        yield f"azimuth {start:+} and negated", _posed(given, mirrored @ _turn(-start))


def _world(given: Camera) -> Iterator[tuple[str, Camera]]:
    """Another up axis than +Y, of the camera's world or of the mesh."""
    pose = given.world_to_camera.cpu()
    yield "a camera of a world with Z up, for a mesh with Y up", _posed(given, pose @ _Z_UP.T)
    yield "a mesh with Z up, for a camera of a world with Y up", _posed(given, pose @ _Z_UP)


def _units(given: Camera) -> Iterator[tuple[str, Camera]]:
    """Mesh and camera in different units of length."""
    for unit in UNITS:
        for factor, told in (
            (unit, f"the camera's lengths times {unit:g}"),
            (1 / unit, f"the mesh times {unit:g}"),
        ):
            pose = given.world_to_camera.cpu().clone()
            pose[:3, 3] *= factor
            lens = 1 / factor if given.projection == "orthographic" else 1.0  # pixels per world unit
            yield told, replace(_posed(given, pose), fx=given.fx * lens, fy=given.fy * lens)


def _lens(spec: CameraSpec, given: Camera) -> Iterator[tuple[str, Camera]]:
    """Intrinsics of another image or in other units; an angle of the other side, or in radians."""
    width, height = given.width, given.height
    angle = spec.fov_y_degrees or spec.fov_x_degrees
    if angle is not None:
        told, pixels, other, others = ("fov_y", height, "fov_x", width)
        if spec.fov_y_degrees is None:
            told, pixels, other, others = other, others, told, pixels
        across = focal_length(angle, others)
        yield f"{other}_degrees instead of {told}_degrees", replace(given, fx=across, fy=across)
        if angle < math.pi:
            f = focal_length(math.degrees(angle), pixels)
            yield f"{told} in radians", replace(given, fx=f, fy=f)
        return
    if max(given.fx, given.fy) < LARGEST_NORMALISED:
        for told, x, y in (
            ("intrinsics divided by the image's width and height", width, height),
            ("intrinsics divided by the image's longest side", max(width, height), max(width, height)),
        ):
            yield told, replace(given, fx=given.fx * x, fy=given.fy * y, cx=given.cx * x, cy=given.cy * y)
        half = min(width, height) / 2
        ndc = replace(
            given,
            fx=given.fx * half,
            fy=given.fy * half,
            cx=width / 2 - given.cx * half,
            cy=height / 2 - given.cy * half,
        )
        yield "intrinsics in PyTorch3D's normalised device units", ndc
    if given.cx > 0 and given.cy > 0:
        across, down = 0.5 * width / given.cx, 0.5 * height / given.cy
        size = f"{round(2 * given.cx)}x{round(2 * given.cy)}"
        scaled = replace(given, fx=given.fx * across, fy=given.fy * down, cx=width / 2, cy=height / 2)
        yield f"intrinsics of an image of {size} pixels", scaled
    yield (
        "the principal point counted from the middle of the image",
        replace(given, cx=given.cx + width / 2, cy=given.cy + height / 2),
    )
    yield (
        "x and y of the intrinsics swapped",
        replace(given, fx=given.fy, fy=given.fx, cx=given.cy, cy=given.cx),
    )
    yield "the principal point in the middle of the image", replace(given, cx=width / 2, cy=height / 2)
    per_mm = max(width, height) / SENSOR_MM
    yield (
        "a focal length in millimetres, of 36 mm film",
        replace(given, fx=given.fx * per_mm, fy=given.fy * per_mm, cx=width / 2, cy=height / 2),
    )


def _radians(spec: LookAtCamera, given: Camera) -> Iterator[tuple[str, Camera]]:
    """Angles that were given in radians, and a polar angle, which is counted from straight up."""
    azimuth, elevation = spec.azimuth_degrees, spec.elevation_degrees
    if abs(azimuth) <= 2 * math.pi and abs(elevation) <= math.pi / 2:
        turned = _posed(given, look_at_pose(spec, math.degrees(azimuth), math.degrees(elevation)))
        yield "azimuth and elevation in radians", turned
        for told, lens in _lens(spec, turned):
            if told.endswith("in radians"):
                yield "all angles in radians", lens
    polar = look_at_pose(spec, azimuth, 90.0 - elevation)
    yield "the elevation counted from straight up", _posed(given, polar)


def _matrices(spec: MatrixCamera, given: Camera) -> Iterator[tuple[str, Camera]]:
    """The other conventions, the other direction, the rotation transposed, and all of these together."""
    told = WrittenPose.of(spec)
    for transposed in (False, True):
        for direction in sorted(DIRECTIONS, key=lambda direction: direction != told.direction):
            for convention in AXES:
                reading = replace(told, convention=convention, direction=direction, transposed=transposed)
                yield reading.describe(), _posed(given, reading.world_to_camera())


def _posed(given: Camera, pose: Tensor) -> Camera:
    return replace(given, world_to_camera=pose)


def _turn(degrees: float) -> Tensor:
    """(4, 4): turns the world about +Y."""
    a = math.radians(degrees)
    rows = [[math.cos(a), 0, math.sin(a), 0], [0, 1, 0, 0], [-math.sin(a), 0, math.cos(a), 0], [0, 0, 0, 1]]
    return torch.tensor(rows)


def _same(one: Camera, other: Camera) -> bool:
    a, b = (
        torch.cat([c.world_to_camera.cpu().flatten(), torch.tensor([c.fx, c.fy, c.cx, c.cy])])
        for c in (one, other)
    )
    return torch.allclose(a, b, rtol=SAME, atol=SAME)
