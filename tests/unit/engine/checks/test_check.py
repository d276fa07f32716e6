"""What the checks find on a lopsided box and its own picture, when nothing is wrong and when one thing is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
import torch
from surfaces import sphere

from refine_engine.cameras.seen import hard_silhouette
from refine_engine.cameras.spec import AXES, camera_from_spec, read_camera
from refine_engine.checks.check import GivenPlane, check_inputs, refuse
from refine_engine.checks.look import MANY_FACES, thinned
from refine_engine.errors import (
    CameraInvalid,
    InputError,
    ObjectOutOfView,
    OptionsInvalid,
    SilhouetteInvalid,
)
from refine_engine.values import Camera, Mesh, View
from refine_proto.cameras import MatrixCamera
from refine_proto.checks import Checks, Code, Finding, Severity

WIDTH, HEIGHT = 96, 64
LOOK_AT = {"type": "look_at", "azimuth_degrees": 60, "elevation_degrees": 25, "distance": 2.2}
IN_RADIANS = {"azimuth_degrees": 1.0472, "elevation_degrees": 0.4363}


def box(scale: float = 1.0) -> Mesh:
    """A long box off the origin, so that no two cameras see it alike: x 0..1.2, y 0..0.3, z 0..0.5."""
    corners = [[x, y, z] for x in (0.0, 1.2) for y in (0.0, 0.3) for z in (0.0, 0.5)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return Mesh(torch.tensor(corners) * scale, torch.tensor(faces))


def camera_of(spec: Mapping[str, Any], width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return camera_from_spec(read_camera(spec), width, height)


def picture(camera: Camera) -> torch.Tensor:
    return hard_silhouette(box(), camera).float()


def found(
    spec: Mapping[str, Any],
    silhouette: torch.Tensor,
    mesh: Mesh | None = None,
    checks: Checks = Checks.WARN,
) -> Sequence[Finding]:
    """What is found with the box under this camera and that silhouette."""
    height, width = silhouette.shape
    return check_inputs(
        mesh or box(), View(silhouette, camera_of(spec, width, height)), read_camera(spec), checks
    )


def matrix(camera: Camera, convention: str = "opencv", **changes: Any) -> dict[str, Any]:
    """The camera as a matrix camera of this convention."""
    axes = torch.tensor(AXES[convention])  # type: ignore[index]
    return {
        "type": "matrix",
        "convention": convention,
        "world_to_camera": (axes[:, None] * camera.world_to_camera).tolist(),
        "intrinsics": {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    } | changes


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (960, 640)])
@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_nothing_is_found_where_nothing_is_wrong(size: tuple[int, int], scale: float) -> None:
    camera = camera_of(LOOK_AT, *size)
    assert found(LOOK_AT, picture(camera), box(scale)) == ()


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"azimuth_degrees": -60}, "azimuth negated"),
        ({"azimuth_degrees": 150}, "azimuth -90"),
        ({"azimuth_degrees": -30}, "azimuth +90"),
        ({"azimuth_degrees": 30}, "azimuth +90 and negated"),
        ({"elevation_degrees": 65}, "the elevation counted from straight up"),
        (IN_RADIANS, "azimuth and elevation in radians"),
        (IN_RADIANS | {"fov_y_degrees": 1.0472}, "all angles in radians"),
        ({"fov_y_degrees": 1.0472}, "fov_y in radians"),
        ({"fov_y_degrees": 81.787}, "fov_x_degrees instead of fov_y_degrees"),
        ({"distance": 22}, "the mesh times 10"),
        ({"distance": 0.022}, "the camera's lengths times 100"),
        ({"distance": 2200}, "the mesh times 1000"),
    ],
)  # fmt: skip
def test_the_right_reading_of_a_look_at_is_named(wrong: dict[str, float], name: str) -> None:
    """With a camera that can be sent instead, and that is the true one."""
    true = camera_of(LOOK_AT)
    findings = found(LOOK_AT | wrong, picture(true))
    reading = findings[0].reading
    assert reading is not None
    assert reading.name == name
    assert reading.silhouette_iou > 0.97
    assert f"did you mean {name}? it gives a 2D IoU of" in findings[0].message
    instead = camera_from_spec(reading.camera, WIDTH, HEIGHT)
    torch.testing.assert_close(instead.world_to_camera, true.world_to_camera, atol=1e-3, rtol=1e-3)
    assert instead.fy == pytest.approx(true.fy, rel=1e-3)


def test_a_convention_and_a_direction_are_named() -> None:
    true = camera_of(LOOK_AT)
    opengl = torch.tensor(AXES["opengl"])[:, None] * true.world_to_camera
    spec = matrix(true, world_to_camera=None, camera_to_world=torch.linalg.inv(opengl).tolist())
    (finding,) = found({name: v for name, v in spec.items() if v is not None}, picture(true))
    assert (finding.code, finding.severity) == (Code.OBJECT_OUT_OF_VIEW, Severity.REFUSED)
    assert finding.message == (
        "expected the object in the image, got one that is entirely behind the camera; "
        "did you mean convention opengl, camera_to_world? it gives a 2D IoU of 1.00"
    )


def test_a_rotation_that_was_not_transposed_is_named() -> None:
    true = camera_of(LOOK_AT)
    spec = matrix(true, "pytorch3d")
    rows = torch.tensor(spec["world_to_camera"])
    rows[:3, :3] = rows[:3, :3].T.clone()
    findings = found(spec | {"world_to_camera": rows.tolist()}, picture(true))
    assert findings[0].reading is not None
    assert findings[0].reading.name == "convention pytorch3d, world_to_camera with the rotation transposed"


def test_another_up_axis_is_named_on_either_side() -> None:
    true = camera_of(LOOK_AT)
    spec = matrix(true)
    z_up = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    blender = spec | {"world_to_camera": (true.world_to_camera @ z_up).tolist()}
    by_camera = found(blender, picture(true))[0].reading
    assert by_camera is not None
    assert by_camera.name == "a camera of a world with Z up, for a mesh with Y up"
    lying = Mesh(box().vertices @ z_up[:3, :3], box().faces)  # x, y, z -> x, -z, y
    by_mesh = found(spec, picture(true), lying)[0].reading
    assert by_mesh is not None
    assert by_mesh.name == "a mesh with Z up, for a camera of a world with Y up"


@pytest.mark.parametrize(
    ("scale", "name"),
    [
        ((0.5, 0.5), "intrinsics of an image of 48x32 pixels"),
        ((3.0, 3.0), "intrinsics of an image of 288x192 pixels"),
        ((1 / WIDTH, 1 / HEIGHT), "intrinsics divided by the image's width and height"),
        ((1 / WIDTH, 1 / WIDTH), "intrinsics divided by the image's longest side"),
    ],
)
def test_other_units_of_the_intrinsics_are_named(scale: tuple[float, float], name: str) -> None:
    true = camera_of(LOOK_AT)
    x, y = scale
    intrinsics = {"fx": true.fx * x, "fy": true.fy * y, "cx": true.cx * x, "cy": true.cy * y}
    findings = found(matrix(true, intrinsics=intrinsics), picture(true))
    assert findings[0].reading is not None
    assert findings[0].reading.name == name


@pytest.mark.parametrize(
    ("scale", "cx", "cy", "name"),
    [
        (1.0, 0.0, 0.0, "the principal point counted from the middle of the image"),
        (1.0, 20.0, 50.0, "the principal point in the middle of the image"),
        (1.0, 60.0, 10.0, "the principal point in the middle of the image"),
        (1.0, HEIGHT / 2, WIDTH / 2, "x and y of the intrinsics swapped"),
        (36 / WIDTH, WIDTH / 2, HEIGHT / 2, "a focal length in millimetres, of 36 mm film"),
        (2 / HEIGHT, 0.01, 0.01, "intrinsics in PyTorch3D's normalised device units"),
    ],
)
def test_other_principal_points_and_units_of_length_are_named(
    scale: float, cx: float, cy: float, name: str
) -> None:
    true = camera_of(LOOK_AT)
    intrinsics = {"fx": true.fx * scale, "fy": true.fy * scale, "cx": cx, "cy": cy}
    reading = found(matrix(true, intrinsics=intrinsics), picture(true))[0].reading
    assert reading is not None
    assert reading.name == name


def test_units_of_an_orthographic_camera_are_named() -> None:
    lens = {"fx": 40, "fy": 40, "cx": 48, "cy": 32}
    true = camera_of(matrix(camera_of(LOOK_AT), projection="orthographic", intrinsics=lens))
    findings = found(matrix(true, projection="orthographic"), picture(true), box(10))
    reading = findings[0].reading
    assert reading is not None
    assert reading.name == "the camera's lengths times 10"
    assert isinstance(reading.camera, MatrixCamera)
    assert reading.camera.projection == "orthographic"


def test_a_mirrored_camera_of_a_symmetric_object_is_no_finding() -> None:
    """The two see the same, so nobody can tell which is meant."""
    centred = Mesh(box().vertices - torch.tensor([0.6, 0.15, 0.25]), box().faces)
    front = {**LOOK_AT, "azimuth_degrees": 0}
    silhouette = hard_silhouette(centred, camera_of(front)).float()
    assert found({**front, "azimuth_degrees": 180}, silhouette, centred) == ()


def test_wrong_proportions_are_no_wrong_camera() -> None:
    """Of a box that was predicted too wide, other azimuths see a narrower one: the outline stays a box's."""
    cube = box().vertices / torch.tensor([1.2, 0.3, 0.5]) - 0.5
    wide = Mesh(cube * torch.tensor([0.5, 0.9, 0.3]), box().faces)
    narrow = Mesh(wide.vertices * torch.tensor([0.6, 1.0, 1.0]), wide.faces)
    front = {**LOOK_AT, "azimuth_degrees": 0, "elevation_degrees": 5}
    camera = camera_of(front)
    findings = found(front, hard_silhouette(narrow, camera).float(), wide)
    assert [finding.code for finding in findings] == [Code.MESH_TOO_COARSE]  # it is a box of 8 vertices


def test_an_inverted_mask_is_refused() -> None:
    """And nothing is said about the camera, which cannot be judged by it."""
    (finding,) = found(LOOK_AT, 1 - picture(camera_of(LOOK_AT)))
    assert (finding.code, finding.severity) == (Code.SILHOUETTE_INVERTED, Severity.REFUSED)
    assert "a 2D IoU of 1.00, the object 0.00; invert it" in finding.message
    with pytest.raises(SilhouetteInvalid, match=r"options\.checks: off refines it all the same"):
        refuse([finding])


def test_an_inverted_mask_of_a_bad_mesh_is_a_warning() -> None:
    mesh = Mesh(box().vertices * torch.tensor([1.0, 2.0, 1.0]), box().faces)
    (finding,) = found(LOOK_AT, 1 - picture(camera_of(LOOK_AT)), mesh)
    assert (finding.code, finding.severity) == (Code.SILHOUETTE_INVERTED, Severity.WARNING)


def test_a_mask_that_covers_nearly_everything_is_told() -> None:
    silhouette = torch.ones(HEIGHT, WIDTH)
    silhouette[0] = 0
    assert [finding.code for finding in found(LOOK_AT, silhouette)] == [Code.SILHOUETTE_FILLS_IMAGE]


def test_a_camera_within_the_object_is_refused() -> None:
    """In millimetres under a camera in metres; a stray fragment makes no inside of an outside."""
    (finding,) = found(LOOK_AT, picture(camera_of(LOOK_AT)), box(1000.0))
    assert (finding.code, finding.severity) == (Code.CAMERA_INSIDE_OBJECT, Severity.REFUSED)
    assert finding.reading is not None
    assert finding.reading.name == "the camera's lengths times 1000"
    with pytest.raises(CameraInvalid, match="are mesh and camera in the same unit of length; did you mean"):
        refuse([finding])
    far = torch.tensor([[60.0, 30, 30], [60.01, 30, 30], [60, 30.01, 30]])
    with_fragment = Mesh(
        torch.cat([box().vertices, far]), torch.cat([box().faces, torch.tensor([[8, 9, 10]])])
    )
    assert found(LOOK_AT, picture(camera_of(LOOK_AT)), with_fragment) == ()


def test_a_camera_in_the_empty_corner_of_an_object_is_not_within_it() -> None:
    """It looks away from the other leg of the angle, along the first: nothing is behind it."""
    legs = [Mesh(box().vertices * torch.tensor(s) + torch.tensor(o), box().faces) for s, o in (
        ([1.0, 1.0, 0.2], [0.0, 0.0, -1.0]), ([0.1, 1.0, 3.0], [-0.2, 0.0, -1.0])
    )]  # fmt: skip
    angle = Mesh(torch.cat([leg.vertices for leg in legs]), torch.cat([legs[0].faces, legs[1].faces + 8]))
    pose = torch.eye(4).tolist()
    spec = matrix(camera_of(LOOK_AT), "opengl", world_to_camera=pose)
    codes = [finding.code for finding in found(spec, picture(camera_of(LOOK_AT)), angle)]
    assert Code.CAMERA_INSIDE_OBJECT not in codes


def test_out_of_view_without_a_better_reading() -> None:
    true = camera_of(LOOK_AT)
    intrinsics = {"fx": 1000, "fy": 1000, "cx": -5000, "cy": 32}
    (finding,) = found(matrix(true, intrinsics=intrinsics), picture(true))
    assert finding.message == "expected the object in the image, got one that lies outside the 96x64 pixels"
    with pytest.raises(ObjectOutOfView):
        refuse([finding])


def test_around_the_camera_and_smaller_than_a_pixel_is_told() -> None:
    """In front of the first one's plane is only the corner at the origin, and no face as a whole."""
    silhouette = picture(camera_of(LOOK_AT))
    spec = {**LOOK_AT, "azimuth_degrees": 45, "elevation_degrees": 35, "distance": 0.1}
    around = found(spec, silhouette)[0]
    assert around.code is Code.CAMERA_INSIDE_OBJECT or "got one around the camera" in around.message
    tiny = found(LOOK_AT, silhouette, box(1e-4))[0]
    assert tiny.code is Code.OBJECT_OUT_OF_VIEW
    assert "got one of 0.00" in tiny.message
    assert "which covers the middle of none of the 96x64" in tiny.message


def test_no_overlap_is_refused() -> None:
    silhouette = torch.zeros(HEIGHT, WIDTH)
    silhouette[50:60, 2:14] = 1
    (finding,) = found(LOOK_AT, silhouette)
    assert (finding.code, finding.severity) == (Code.NO_OVERLAP, Severity.REFUSED)
    assert "check the camera and where the mesh is" in finding.message


def test_a_low_overlap_that_no_reading_explains_is_a_warning() -> None:
    silhouette = torch.zeros(HEIGHT, WIDTH)
    silhouette[5:60, 40:47] = 1
    (finding,) = found(LOOK_AT, silhouette)
    assert (finding.code, finding.severity) == (Code.LOW_OVERLAP, Severity.WARNING)


def test_few_pixels_are_told() -> None:
    """Of the silhouette, and of the mesh under the camera."""
    far = {**LOOK_AT, "distance": 30}
    assert Code.OBJECT_TOO_SMALL in [finding.code for finding in found(far, picture(camera_of(far)))]
    drawn = [
        finding
        for finding in found(far, picture(camera_of(LOOK_AT)))
        if finding.code is Code.OBJECT_TOO_SMALL
    ]
    assert len(drawn) == 1
    assert "under the camera" in drawn[0].message


@pytest.mark.parametrize(("cx", "sides"), [(75, "right"), (8, "left")])
def test_an_object_that_the_border_cuts_off_is_told(cx: float, sides: str) -> None:
    true = camera_of(LOOK_AT)
    spec = matrix(true, intrinsics={"fx": true.fx, "fy": true.fy, "cx": cx, "cy": 32})
    (finding,) = found(spec, picture(camera_of(spec)))
    assert finding.code is Code.SILHOUETTE_CUT_OFF
    assert f"cut off at the {sides}" in finding.message


def test_a_mirror_plane_that_another_axis_beats_is_told() -> None:
    """The angle of two boxes mirrors itself across Z only."""
    view = View(picture(camera_of(LOOK_AT)), camera_of(LOOK_AT))
    roof = Mesh(box().vertices.clone(), box().faces)
    roof.vertices[roof.vertices[:, 0] > 1, 1] += 0.6  # sheared in x and y
    spec = read_camera(LOOK_AT)
    told = [
        finding
        for finding in check_inputs(roof, view, spec, symmetry=GivenPlane((1.0, 0.0, 0.0)))
        if finding.code is Code.SYMMETRY_ELSEWHERE
    ]
    assert len(told) == 1
    assert "one across Z is off by" in told[0].message
    assert "give symmetry_normal 0 0 1" in told[0].message
    with pytest.raises(OptionsInvalid):
        refuse([told[0].model_copy(update={"severity": Severity.REFUSED})])
    right = check_inputs(roof, view, spec, symmetry=GivenPlane((0.0, 0.0, -2.0)))
    shifted = check_inputs(roof, view, spec, symmetry=GivenPlane((0.0, 0.0, 1.0), offset=0.9))
    assert Code.SYMMETRY_ELSEWHERE not in [finding.code for finding in right]
    assert Code.SYMMETRY_ELSEWHERE in [finding.code for finding in shifted]


def test_strict_refuses_everything_and_off_nothing() -> None:
    true = camera_of(LOOK_AT)
    wrong = {**LOOK_AT, "azimuth_degrees": -60}
    (strict,) = found(wrong, picture(true), checks=Checks.STRICT)
    assert (strict.code, strict.severity) == (Code.CAMERA_MISREAD, Severity.REFUSED)
    with pytest.raises(CameraInvalid):
        refuse([strict])
    (off,) = found(LOOK_AT, 1 - picture(true), checks=Checks.OFF)
    assert (off.code, off.severity) == (Code.SILHOUETTE_INVERTED, Severity.WARNING)
    refuse([off])


def test_several_refused_findings_are_told_in_one_error() -> None:
    refused = [
        Finding(code=code, severity=Severity.REFUSED, message=code.lower())
        for code in (Code.NO_OVERLAP, Code.LOW_OVERLAP)
    ]
    with pytest.raises(InputError, match="no_overlap; low_overlap ") as error:
        refuse(refused)
    assert isinstance(error.value, ObjectOutOfView)


def test_a_large_mesh_is_thinned_out_and_looks_the_same() -> None:
    """A finely divided ball, whose every face is its own after snapping."""
    side = 240
    u, v = torch.meshgrid(torch.linspace(0, 6.2832, side), torch.linspace(0.01, 3.13, side), indexing="ij")
    ball = torch.stack([u.cos() * v.sin(), v.cos(), u.sin() * v.sin()], -1).reshape(-1, 3) * 0.5
    a = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).flatten()
    faces = torch.cat([torch.stack([a, a + 1, a + side], 1), torch.stack([a + 1, a + side + 1, a + side], 1)])
    stray = torch.tensor([[90.0, 0, 0], [90.01, 0, 0], [90, 0.01, 0]])
    corners = torch.tensor([[0, 1, 2]]) + len(ball)
    mesh = Mesh(torch.cat([ball, stray]), torch.cat([faces, corners]))
    assert len(mesh.faces) > MANY_FACES
    thin = thinned(mesh)
    assert len(thin.faces) < len(mesh.faces) * 0.8
    camera = camera_of(LOOK_AT, 192, 128)
    before, after = hard_silhouette(mesh, camera), hard_silhouette(thin, camera)
    assert float((before & after).sum() / (before | after).sum()) > 0.97
    assert thinned(box()).faces.shape == box().faces.shape


def test_a_mesh_of_few_triangles_cannot_follow_a_silhouette() -> None:
    """A box or a ball of 40 vertices that is seen smaller; a ball of 1,500 vertices can."""
    few, many = (Mesh(torch.from_numpy(v).float(), torch.from_numpy(f)) for v, f in map(sphere, (40, 1500)))
    for mesh, expected in ((box(), [Code.MESH_TOO_COARSE]), (few, [Code.MESH_TOO_COARSE]), (many, [])):
        seen = hard_silhouette(Mesh(0.8 * mesh.vertices, mesh.faces), camera_of(LOOK_AT)).float()
        assert [finding.code for finding in found(LOOK_AT, seen, mesh)] == expected
