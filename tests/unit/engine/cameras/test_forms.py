"""Any camera, in any of the forms in which it may be written, is one and the same camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from refine_engine.cameras.readings import other_readings
from refine_engine.cameras.spec import AXES, Convention, camera_from_spec, read_camera
from refine_engine.values import Camera

WIDTH, HEIGHT = 200, 100
CONVENTIONS = st.sampled_from(sorted(AXES))
DIRECTIONS = st.sampled_from(["world_to_camera", "camera_to_world"])
INTRINSICS = {"fx": 50, "fy": 60, "cx": 90, "cy": 50}


def camera(spec: Mapping[str, Any]) -> Camera:
    return camera_from_spec(read_camera(spec), WIDTH, HEIGHT)


def same(one: Camera, other: Camera) -> bool:
    return torch.allclose(one.world_to_camera, other.world_to_camera, atol=1e-4) and (
        np.allclose([one.fx, one.fy, one.cx, one.cy], [other.fx, other.fy, other.cx, other.cy])
    )


@st.composite
def poses(draw: st.DrawFn) -> Any:
    """A rigid world-to-camera matrix (4, 4) in OpenCV's axes."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=draw(st.integers(0, 10_000))).as_matrix()
    pose[:3, 3] = draw(st.tuples(*[st.floats(-20, 20)] * 3))
    return pose


def written(pose: Any, convention: Convention, direction: str, **lens: Any) -> dict[str, Any]:
    """The pose as a `matrix` camera of this convention and direction."""
    matrix = np.array(AXES[convention])[:, None] * pose
    rows = np.linalg.inv(matrix) if direction == "camera_to_world" else matrix
    return {"type": "matrix", "convention": convention, direction: rows.tolist()} | (
        lens or {"intrinsics": INTRINSICS}
    )


@given(poses(), CONVENTIONS, DIRECTIONS, st.booleans())
def test_every_convention_and_direction_says_the_same(
    pose: Any, convention: Convention, direction: str, flat: bool
) -> None:
    spec = written(pose, convention, direction)
    if flat:
        spec[direction] = [cell for row in spec[direction] for cell in row]
    expected = Camera(torch.from_numpy(pose).float(), 50, 60, 90, 50, WIDTH, HEIGHT)
    assert same(camera(spec), expected)


@given(
    azimuth=st.floats(-720, 720), elevation=st.floats(-90, 90), distance=st.floats(0.1, 50),
    fov=st.floats(1, 179), convention=CONVENTIONS, direction=DIRECTIONS,
)  # fmt: skip
def test_a_look_at_camera_is_its_matrix_and_sees_the_origin_in_the_middle(
    azimuth: float, elevation: float, distance: float, fov: float, convention: Convention, direction: str
) -> None:
    angles = {"azimuth_degrees": azimuth, "elevation_degrees": elevation, "distance": distance}
    looking = camera({"type": "look_at", "fov_y_degrees": fov} | angles)
    pose = looking.world_to_camera.double().numpy()
    np.testing.assert_allclose(pose[:3, 3], [0, 0, distance], atol=1e-4)
    assert same(camera(written(pose, convention, direction, fov_y_degrees=fov)), looking)


@given(poses(), CONVENTIONS, DIRECTIONS, CONVENTIONS, DIRECTIONS)
def test_a_mislabelled_matrix_has_the_right_reading_among_the_others(
    pose: Any, convention: Convention, direction: str, wrong_convention: str, wrong_direction: str
) -> None:
    right = written(pose, convention, direction)
    wrong = {name: value for name, value in right.items() if name != direction}
    wrong |= {"convention": wrong_convention, wrong_direction: right[direction]}
    readings = [camera(wrong), *other_readings(read_camera(wrong), camera(wrong)).values()]
    assert any(same(reading, camera(right)) for reading in readings)
