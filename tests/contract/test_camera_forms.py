"""One camera in every form that it may come in is one camera in the engine."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refine_engine import Camera, camera_from_spec
from refine_proto.camera_files import read_camera_file
from refine_proto.cameras import CAMERA_SPEC, PyTorch3DCamera
from refine_proto.convert import to_message, to_model
from refine_proto.errors import CameraInvalid
from refine_proto.models import RefinementSpec
from refine_proto.v1 import refine_pb2

WIDTH, HEIGHT = 64, 48
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # opencv <-> opengl
Matrix = NDArray[np.float64]

rotations = st.builds(
    lambda x, y, z, w: Rotation.from_quat([x, y, z, w]),
    *(st.floats(-1, 1) for _ in range(3)),
    st.floats(0.05, 1),
)
shifts = st.tuples(*(st.floats(-5, 5) for _ in range(3)))
focal_lengths = st.floats(5, 500)


def pose(rotation: Rotation, shift: tuple[float, ...]) -> Matrix:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), shift
    return matrix


def camera_of(spec: Any) -> Camera:
    """Through the contract, and once more over the wire."""
    read = RefinementSpec.model_validate({"camera": spec})
    message = to_message(read, refine_pb2.RefinementSpec)
    assert to_model(message, RefinementSpec) == read
    return camera_from_spec(read.camera, WIDTH, HEIGHT)


def same(one: Camera, other: Camera) -> None:
    torch.testing.assert_close(one.world_to_camera, other.world_to_camera, atol=1e-4, rtol=1e-5)
    lenses = [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in (one, other)]
    assert lenses[0] == pytest.approx(lenses[1], rel=1e-6)


@given(rotation=rotations, shift=shifts, focal=focal_lengths)
def test_the_forms_of_a_matrix_agree(rotation: Rotation, shift: tuple[float, ...], focal: float) -> None:
    matrix = pose(rotation, shift)
    lens = {"fx": focal, "fy": 1.2 * focal, "cx": 30.0, "cy": 20.0}
    k: list[list[float]] = [[focal, 0, 30.0], [0, 1.2 * focal, 20.0], [0, 0, 1]]
    told = {"type": "matrix", "convention": "opencv"}
    wanted = camera_of(told | {"world_to_camera": matrix.tolist(), "intrinsics": lens})
    to_world = np.linalg.inv(matrix) @ FLIP
    for form in (
        told | {"world_to_camera": matrix[:3].tolist(), "intrinsics": k},
        told | {"world_to_camera": matrix[:3].ravel().tolist(), "intrinsics": lens},
        told | {"world_to_camera": matrix.ravel().tolist(), "intrinsics": np.ravel(k).tolist()},
        told | {"convention": "opengl", "camera_to_world": to_world[:3].tolist(), "intrinsics": k},
    ):
        same(camera_of(form), wanted)


@given(rotation=rotations, shift=shifts, fov=st.floats(5, 120))
def test_pytorch3ds_own_r_and_t(rotation: Rotation, shift: tuple[float, ...], fov: float) -> None:
    """A point by PyTorch3D's rule, X R + T with +X left and +Y up, is where the engine sees it."""
    r = rotation.as_matrix()
    camera = camera_of({"type": "pytorch3d", "R": [r.tolist()], "T": [list(shift)], "fov_y_degrees": fov})
    point = np.array([0.3, -0.2, 0.5])
    by_rule = (point @ r + np.array(shift)) * [-1, -1, 1]
    ours = camera.world_to_camera.double().numpy() @ [*point, 1.0]
    assert ours[:3] == pytest.approx(by_rule, abs=1e-4)
    assert camera.fy == pytest.approx(HEIGHT / 2 / math.tan(math.radians(fov) / 2))
    model = PyTorch3DCamera(R=r.tolist(), T=shift, fov_y_degrees=fov)
    same(camera_from_spec(CAMERA_SPEC.validate_python(model), WIDTH, HEIGHT), camera)


def test_a_pytorch3d_camera_on_the_wire() -> None:
    spec = refine_pb2.RefinementSpec()
    spec.camera.pytorch3d.R.extend([1, 0, 0, 0, 0, -1, 0, 1, 0])
    spec.camera.pytorch3d.T.extend([0, 0, 2])
    spec.camera.pytorch3d.fov_x_degrees = 50
    camera = camera_from_spec(to_model(spec, RefinementSpec).camera, WIDTH, HEIGHT)
    rows = [[-1, 0, 0, 0], [0, 0, -1, 0], [0, -1, 0, 2]]
    assert camera.world_to_camera[:3].tolist() == [[float(x) for x in row] for row in rows]


LOOK_AT = {"type": "look_at", "azimuth_degrees": 40, "elevation_degrees": 25, "distance": 2.2}


@given(fov=st.floats(5, 120))
def test_a_field_of_view_across_and_the_same_from_top_to_bottom(fov: float) -> None:
    down = 2 * math.degrees(math.atan(math.tan(math.radians(fov) / 2) * HEIGHT / WIDTH))
    same(camera_of(LOOK_AT | {"fov_x_degrees": fov}), camera_of(LOOK_AT | {"fov_y_degrees": down}))
    told = {"type": "matrix", "convention": "opencv", "world_to_camera": np.eye(4).tolist()}
    same(camera_of(told | {"fov_x_degrees": fov}), camera_of(told | {"fov_y_degrees": down}))


@given(roll=st.floats(-180, 180))
def test_roll_turns_the_camera_clockwise_so_that_the_picture_turns_the_other_way(roll: float) -> None:
    level, turned = camera_of(LOOK_AT), camera_of(LOOK_AT | {"roll_degrees": roll})
    up = level.world_to_camera[:3, :3].T @ torch.tensor([0.0, -1.0, 0.0])  # to the picture's upper edge
    seen = turned.world_to_camera[:3, :3] @ up
    angle = math.radians(roll)
    assert seen.tolist() == pytest.approx([-math.sin(angle), -math.cos(angle), 0.0], abs=1e-5)
    assert turned.world_to_camera[:3, 3].tolist() == pytest.approx(level.world_to_camera[:3, 3].tolist())


def nerf(matrix: Matrix, **more: Any) -> dict[str, Any]:
    return {"transform_matrix": (np.linalg.inv(matrix) @ FLIP).tolist(), **more}


@settings(max_examples=20)
@given(rotation=rotations, shift=shifts, focal=focal_lengths)
def test_files_of_other_programs(
    tmp_path_factory: pytest.TempPathFactory, rotation: Rotation, shift: tuple[float, ...], focal: float
) -> None:
    folder = tmp_path_factory.mktemp("cameras")
    matrix, other = pose(rotation, shift), pose(Rotation.identity(), (0, 0, 3))
    told = {"type": "matrix", "convention": "opencv", "world_to_camera": matrix.tolist()}
    lens = {"fx": focal, "fy": focal, "cx": 30.0, "cy": 25.0, "width": WIDTH, "height": HEIGHT}
    wanted = camera_of(told | {"intrinsics": lens})

    frames = [nerf(other, file_path="./images/0001.png"), nerf(matrix, file_path="./images/0002.png")]
    values = {"fl_x": focal, "fl_y": focal, "cx": 30.0, "cy": 25.0, "w": WIDTH, "h": HEIGHT, "k1": 1e-3}
    (folder / "transforms.json").write_text(json.dumps(values | {"frames": frames}))
    for name in ("./images/0002.png", "images/0002.png", "0002.png", "0002"):
        spec = read_camera_file(f"{folder}/transforms.json#{name}")
        same(camera_from_spec(spec, WIDTH, HEIGHT), wanted)

    angle = 2 * math.atan(WIDTH / 2 / focal)
    (folder / "one.json").write_text(json.dumps({"camera_angle_x": angle, "frames": [frames[1]]}))
    centred = camera_of(told | {"intrinsics": lens | {"cx": WIDTH / 2, "cy": HEIGHT / 2}})
    same(camera_from_spec(read_camera_file(folder / "one.json"), WIDTH, HEIGHT), centred)

    x, y, z, w = rotation.as_quat()
    (folder / "cameras.txt").write_text(
        f"# a comment\n7 SIMPLE_PINHOLE {WIDTH} {HEIGHT} {focal} 30 25\n8 PINHOLE 9 9 1 1 1 1\n"
    )
    (folder / "images.txt").write_text(
        "# IMAGE_ID, ...\n1 1 0 0 0 0 0 3 8 side.jpg\n\n"
        f"2 {w} {x} {y} {z} {' '.join(map(str, shift))} 7 a b.jpg\n"
        "10.5 20.5 -1 3 4 5\n"
    )
    same(camera_from_spec(read_camera_file(f"{folder}#a b.jpg"), WIDTH, HEIGHT), wanted)


@pytest.mark.parametrize(
    ("name", "content", "path", "says"),
    [
        ("t.json", {"frames": []}, "t.json", "got 0; there are: none"),
        (
            "t.json",
            {"camera_angle_x": 1, "frames": [nerf(np.eye(4), file_path="a")] * 1},
            "t.json#b",
            "are: a",
        ),
        (
            "t.json",
            {"frames": [nerf(np.eye(4), file_path="a")]},
            "t.json",
            "expected camera_angle_x, or fl_x, w",
        ),
        ("t.json", {"frames": [{"file_path": "a"}]}, "t.json", "a file_path and a transform_matrix"),
        (
            "t.json",
            {"k1": -0.3, "frames": [nerf(np.eye(4), file_path="a")]},
            "t.json",
            "distortion, got k1 -0.3",
        ),
        (
            "t.json",
            {"camera_angle_x": "x", "frames": [nerf(np.eye(4), file_path="a")]},
            "t.json",
            "numbers for",
        ),
        ("c.json", LOOK_AT, "c.json#a", "expected a transforms.json or a COLMAP folder before #a"),
        ("c.json", LOOK_AT | {"distance": 0}, "c.json", "/camera/distance: expected a number greater than 0"),
        ("c.json", [1], "c.json", "/camera: expected an object"),
    ],
)
def test_files_that_name_no_camera(tmp_path: Path, name: str, content: Any, path: str, says: str) -> None:
    (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(CameraInvalid, match=says):
        read_camera_file(tmp_path / path)


@pytest.mark.parametrize(
    ("camera", "image", "says"),
    [
        ("1 FISHEYE 9 9 1 1 1", "1 1 0 0 0 0 0 3 1 a", "COLMAP's camera models .* got FISHEYE"),
        ("1 OPENCV 9 9 5 5 1 1 0.2 0 0 0", "1 1 0 0 0 0 0 3 1 a", "got parameter 5 0.2"),
        ("1 PINHOLE 9 9 5 5 1 1", "1 1 0 0 0 0 0 3 2 a", "its camera in the COLMAP model"),
        ("1 PINHOLE 9 9 5 5 1 1", "1 0 0 0 0 0 0 3 1 a", "ZeroDivisionError"),
        ("1 PINHOLE 9", "1 1 0 0 0 0 0 3 1 a", "its camera in the COLMAP model"),
        ("1 PINHOLE 9 9 5 5 1 1", "1 1 0 0", "its camera in the COLMAP model"),
    ],
)
def test_colmap_models_that_cannot_be_read(tmp_path: Path, camera: str, image: str, says: str) -> None:
    (tmp_path / "cameras.txt").write_text(camera)
    (tmp_path / "images.txt").write_text(image)
    with pytest.raises(CameraInvalid, match=says):
        read_camera_file(tmp_path)


NETWORKS = [
    # network, where its camera is and what is up in the picture, in the frame of its output
    ({"name": "triposr"}, (1.9, 0, 0), (0, 0, 1), 40),
    ({"name": "triposr", "azimuth_degrees": 90}, (0, 1.9, 0), (0, 0, 1), 40),
    ({"name": "sf3d"}, (0, 0, -1.6), (0, 1, 0), 40),
    ({"name": "instantmesh", "elevation_degrees": 90}, (0, 4, 0), (0, 0, 1), 30),
    ({"name": "instantmesh", "azimuth_degrees": 90}, (-4, 0, 0), (0, 1, 0), 30),
    ({"name": "trellis"}, (0, 0, 2), (0, 1, 0), 40),
    ({"name": "trellis", "azimuth_degrees": 90, "fov_y_degrees": 8}, (2, 0, 0), (0, 1, 0), 8),
    ({"name": "hunyuan3d", "distance": 3}, (0, 0, 3), (0, 1, 0), 49.134),
    ({"name": "pixel2mesh"}, (0, 0, 0), (0, 1, 0), 2 * math.degrees(math.atan(112 / 248))),
    ({"name": "occnet", "distance": 2}, (2, 0, 0), (0, 1, 0), 49.134),
    ({"name": "occnet", "distance": 2, "azimuth_degrees": 90}, (0, 0, 2), (0, 1, 0), 49.134),
]


@pytest.mark.parametrize(("told", "place", "up", "fov"), NETWORKS)
def test_the_cameras_of_networks(told: Any, place: Any, up: Any, fov: float) -> None:
    camera = camera_of({"type": "network", **told})
    to_world = torch.linalg.inv(camera.world_to_camera.double())
    assert to_world[:3, 3].tolist() == pytest.approx(place, abs=1e-6)
    assert (-to_world[:3, 1]).tolist() == pytest.approx(up, abs=1e-6)
    assert camera.fy == pytest.approx(HEIGHT / 2 / math.tan(math.radians(fov) / 2), rel=1e-5)
    if any(place):
        seen = camera.world_to_camera @ torch.tensor([0.0, 0.0, 0.0, 1.0])
        assert seen[:3].tolist() == pytest.approx([0, 0, math.hypot(*place)], abs=1e-5)


def test_a_network_camera_on_the_wire() -> None:
    spec = refine_pb2.RefinementSpec()
    spec.camera.network.name = refine_pb2.NetworkCamera.SF3D
    spec.camera.network.elevation_degrees = 10
    read = to_model(spec, RefinementSpec).camera
    same(
        camera_from_spec(read, WIDTH, HEIGHT),
        camera_of({"type": "network", "name": "sf3d", "elevation_degrees": 10}),
    )
