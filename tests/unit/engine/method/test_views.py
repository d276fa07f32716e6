"""The normalised frame, square targets of images of any shape, the symmetry views."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from refine_engine.cameras.project import project, stack
from refine_engine.cameras.seen import hard_silhouette
from refine_engine.errors import CameraInvalid
from refine_engine.kernels import rasterize
from refine_engine.method.config import RefineConfig
from refine_engine.method.symmetry import mirror_matrix
from refine_engine.method.views import Frame, Region, SymmetryViews, Target, resize
from refine_engine.values import Camera, Mesh, MirrorPlane, View

CPU = torch.device("cpu")


def view_of(mesh: Mesh, camera: Camera) -> View:
    return View(hard_silhouette(mesh, camera).float(), camera)


def plane_of(normal: tuple[float, float, float], offset: float) -> MirrorPlane:
    return MirrorPlane(F.normalize(torch.tensor(normal), dim=0), offset, None)


def target_of(views: list[View], frame: Frame, side: int) -> Target:
    """Of the whole images."""
    return Target.of(views, [Region.whole(view.camera) for view in views], frame, side)


def a_camera(width: int, height: int) -> Camera:
    """Not square, its principal point not in the middle."""
    camera = Camera.look_at(40, 25, 2.2, 50, width, height)
    return replace(camera, cx=camera.cx + 0.06 * width, cy=camera.cy - 0.04 * height)


def orthographic(width: int, height: int) -> Camera:
    camera = a_camera(width, height)
    scale = 0.7 * min(width, height)  # pixels per world unit
    return replace(camera, fx=scale, fy=1.1 * scale, projection="orthographic")


def moved(mesh: Mesh, scale: float, shift: tuple[float, float, float]) -> Mesh:
    return Mesh(mesh.vertices * scale + torch.tensor(shift), mesh.faces)


def test_frame_is_the_unit_box(ball: Mesh) -> None:
    """x in 7 ... 13, y in -3 ... 0, z in 1 ... 3."""
    mesh = Mesh(ball.vertices * torch.tensor([6.0, 3.0, 2.0]) + torch.tensor([10.0, -1.5, 2.0]), ball.faces)
    frame = Frame.of(mesh, None)
    normalised = frame.normalise(mesh.vertices)
    low, high = normalised.amin(0), normalised.amax(0)
    assert float((high - low).max()) == pytest.approx(1.0, abs=1e-5)
    assert frame.scale == pytest.approx(6.0, rel=0.01)
    torch.testing.assert_close(low + high, torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(normalised * frame.scale + frame.centre, mesh.vertices, atol=1e-5, rtol=0)


def test_frame_does_not_see_vertices_without_a_face(ball: Mesh) -> None:
    with_another = Mesh(torch.cat([ball.vertices, torch.tensor([[900.0, 0.0, 0.0]])]), ball.faces)
    one, other = (Frame.of(mesh, None) for mesh in (ball, with_another))
    assert torch.equal(one.centre, other.centre)
    assert one.scale == other.scale


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (1.0, 2.0, -0.5)])
@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_a_given_plane_is_not_moved_by_centring(
    ball: Mesh, normal: tuple[float, float, float], offset: float
) -> None:
    """Points of the world plane n.x = offset lie on n.x = 0 of the frame; mirroring is the same in both."""
    mesh = moved(ball, 2.0, (0.4, -3.0, 1.1))
    frame = Frame.of(mesh, plane_of(normal, offset))
    n = F.normalize(torch.tensor(normal), dim=0)
    on_plane = mesh.vertices - (mesh.vertices @ n - offset)[:, None] * n
    torch.testing.assert_close(frame.normalise(on_plane) @ n, torch.zeros(162), atol=1e-5, rtol=0)
    mirrored = mesh.vertices - 2 * (mesh.vertices @ n - offset)[:, None] * n
    expected = frame.normalise(mesh.vertices) @ mirror_matrix(n)
    torch.testing.assert_close(frame.normalise(mirrored), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("make_camera", [a_camera, orthographic])
@pytest.mark.parametrize(("width", "height"), [(60, 40), (40, 60), (50, 50), (41, 60), (301, 200)])
@pytest.mark.parametrize("side", [48, 120])
def test_vertices_land_where_the_input_camera_sees_them(
    ball: Mesh, make_camera: Callable[[int, int], Camera], width: int, height: int, side: int
) -> None:
    """A position in the input image, shifted by the padding, times the zoom."""
    mesh = moved(ball, 1.3, (0.1, 0.2, -0.1))
    camera = make_camera(width, height)
    frame = Frame.of(mesh, None)
    target = target_of([view_of(mesh, camera)], frame, side)
    is_flat = camera.projection == "orthographic"
    seen = project(mesh.vertices, *stack([camera], CPU), orthographic=is_flat)[0, :, :2]
    longest = max(width, height)
    padding = torch.tensor([(longest - width) // 2, (longest - height) // 2])
    screen = target.project(frame.normalise(mesh.vertices))[0]
    torch.testing.assert_close(screen[:, :2], (seen + padding) * side / longest, atol=1e-3, rtol=0)
    assert target.side == side
    assert target.orthographic == is_flat


@pytest.mark.parametrize("make_camera", [a_camera, orthographic])
@pytest.mark.parametrize(("width", "height"), [(200, 120), (90, 150), (64, 64)])
def test_the_picture_lies_under_the_projection(
    ball: Mesh, make_camera: Callable[[int, int], Camera], width: int, height: int
) -> None:
    """The mesh rendered at the target's camera covers the target's silhouette."""
    mesh = moved(ball, 1.3, (0.1, 0.2, -0.1))
    frame = Frame.of(mesh, None)
    target = target_of([view_of(mesh, make_camera(width, height))], frame, 96)
    screen = target.project(frame.normalise(mesh.vertices))
    covered, wanted = rasterize(screen, mesh.faces, (96, 96)).face >= 0, target.silhouette > 0.5
    covered &= target.known > 0.5
    assert float((covered & wanted).sum() / (covered | wanted).sum()) > 0.96


def test_the_padding_is_unknown(ball: Mesh) -> None:
    """A 60 x 30 image in a square of 60, shown at 40: rows 0-9 and 30-39 are padding."""
    target = target_of([view_of(ball, a_camera(60, 30))], Frame.of(ball, None), 40)
    expected = torch.zeros(40, 40)
    expected[10:30] = 1
    torch.testing.assert_close(target.known[0], expected)
    assert not target.silhouette[0][expected == 0].any()


def test_views_of_several_sizes_become_one_batch(ball: Mesh) -> None:
    views = [view_of(ball, a_camera(60, 40)), view_of(ball, a_camera(80, 100))]
    target = target_of(views, Frame.of(ball, None), 64)
    assert target.silhouette.shape == target.known.shape == (2, 64, 64)
    assert target.project(ball.vertices).shape == (2, 162, 3)


def test_views_of_two_projections_are_refused(ball: Mesh) -> None:
    views = [view_of(ball, a_camera(60, 40)), view_of(ball, orthographic(60, 40))]
    with pytest.raises(CameraInvalid, match=r"one kind of projection, got \['orthographic', 'perspective'\]"):
        target_of(views, Frame.of(ball, None), 64)


@pytest.mark.parametrize(("before", "after"), [(4, 2), (2, 4), (3, 3)])
def test_resize_keeps_the_mean(before: int, after: int) -> None:
    image = torch.rand(before, before, generator=torch.Generator().manual_seed(0))
    resized = resize(image, after)
    assert resized.shape == (after, after)
    torch.testing.assert_close(resized.mean(), image.mean())


def test_resize_by_hand() -> None:
    image = torch.tensor([[1.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]])
    assert resize(image, 2).tolist() == [[0.75, 0.0], [0.0, 0.25]]


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 2.0, -0.5)])
@pytest.mark.parametrize("offset", [0.0, -0.2])
def test_symmetry_views_see_each_other_in_the_mirror(
    normal: tuple[float, float, float], offset: float
) -> None:
    """Picture by T p = flipped picture, by p, of the mesh mirrored in the world plane n.x = offset."""
    vertices = torch.rand(9, 3, generator=torch.Generator().manual_seed(2)) * 4 - 1
    faces = torch.arange(9).reshape(-1, 3)
    plane = plane_of(normal, offset)
    frame = Frame.of(Mesh(vertices, faces), plane)
    views = SymmetryViews.of(RefineConfig(), 64, plane.normal)
    assert views.world_to_camera.shape == (12, 4, 4)
    there = views.project(frame.normalise(vertices))[6:]
    n = plane.normal
    mirrored = vertices - 2 * (vertices @ n - offset)[:, None] * n
    here = views.project(frame.normalise(mirrored))[:6]
    torch.testing.assert_close(there[..., 0], 64 - here[..., 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(there[..., 1:], here[..., 1:], atol=1e-3, rtol=0)


def test_symmetry_views_are_the_papers_rig() -> None:
    config = RefineConfig.paper()
    views = SymmetryViews.of(config, 224, torch.tensor([0.0, 0.0, 1.0]))
    angles = [(azimuth, elevation) for azimuth in (15, 45, 75) for elevation in (-45, 45)]
    rig = [Camera.look_at(*angle, 1.9, 60, 224, 224) for angle in angles]
    expected, intrinsics = stack(rig, CPU)
    torch.testing.assert_close(views.world_to_camera[:6], expected)
    torch.testing.assert_close(views.intrinsics, intrinsics.repeat(2, 1))


def test_the_rig_turns_with_the_plane() -> None:
    """Every camera stands as far from a slanted plane as the paper's from z = 0."""

    def heights(normal: Tensor) -> Tensor:
        m = SymmetryViews.of(RefineConfig(), 64, normal).world_to_camera
        return torch.einsum("bij,bi,j->b", m[:, :3, :3], -m[:, :3, 3], normal)

    slanted = F.normalize(torch.tensor([1.0, 2.0, -0.5]), dim=0)
    torch.testing.assert_close(heights(slanted), heights(torch.tensor([0.0, 0.0, 1.0])), atol=1e-5, rtol=0)


def test_a_small_object_is_compared_as_large_as_its_crop(ball: Mesh) -> None:
    """About 60 pixels of a 1024 x 768 picture: the region, its picture and its camera are the crop's."""
    mesh = Mesh(ball.vertices * torch.tensor([1.2, 1.0, 0.8]), ball.faces)
    focal = 130.0
    camera = replace(Camera.look_at(30, 20, 2.4, 50, 1024, 768), fx=focal, fy=focal, cx=700.0, cy=500.0)
    silhouette = hard_silhouette(ball, camera).float()
    assert 50 < float(silhouette.sum(0).count_nonzero()) < 70
    left, top = 620, 430
    crop = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=160, height=120)
    cropped = View(silhouette[top : top + 120, left : left + 160].contiguous(), crop)
    frame = Frame.of(mesh, None)
    whole, part = Region.around(View(silhouette, camera), mesh), Region.around(cropped, mesh)
    assert part == Region(whole.left - left, whole.top - top, whole.side)
    one = Target.of([View(silhouette, camera)], [whole], frame, 96)
    other = Target.of([cropped], [part], frame, 96)
    assert torch.equal(one.silhouette, other.silhouette)
    assert torch.equal(one.known, other.known)
    torch.testing.assert_close(one.intrinsics, other.intrinsics, atol=1e-3, rtol=0)
    assert float(one.silhouette.mean()) > 0.3  # of the whole picture it was less than a hundredth
    screen = one.project(frame.normalise(mesh.vertices))[..., :2]
    assert 0 <= float(screen.amin()) <= float(screen.amax()) <= 96


def test_a_region_holds_mesh_and_silhouette_with_a_margin() -> None:
    """Silhouette in rows 10-19, columns 20-29; a mesh seen in columns 40-49 and rows 30-39."""
    camera = Camera(torch.eye(4), 10.0, 10.0, 0.0, 0.0, 64, 64, "orthographic")
    silhouette = torch.zeros(64, 64)
    silhouette[10:20, 20:30] = 1
    corners = torch.tensor([[4.0, 3, 1], [5, 3, 1], [5, 4, 1], [4, 4, 1]])
    mesh = Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    # together rows 10-40 and columns 20-50: 30 and a fifth, about (25, 35)
    assert Region.around(View(silhouette, camera), mesh) == Region(left=17, top=7, side=36)
    unseen = Mesh(corners + torch.tensor([100.0, 0.0, 0.0]), mesh.faces)
    assert Region.around(View(silhouette, camera), unseen) == Region(left=19, top=9, side=12)


@pytest.mark.parametrize("side", [48, 32, 100])
def test_a_target_shows_what_is_known(ball: Mesh, side: int) -> None:
    """A pixel of which a part is known has the coverage of that part; what is unknown changes nothing."""
    camera = a_camera(64, 48)
    whole = view_of(ball, camera)
    known = torch.ones(48, 64, dtype=torch.bool)
    known[:, 31:] = False
    target = target_of([replace(whole, known=known)], Frame.of(ball, None), side)
    full = target_of([whole], Frame.of(ball, None), side)
    inside = target.known[0] > 0.999
    torch.testing.assert_close(target.silhouette[0][inside], full.silhouette[0][inside])
    assert float(target.silhouette.max()) <= 1.0 + 1e-6
    assert not target.silhouette[target.known == 0].any()
    assert int(target.background().sum()) < int(full.background().sum())
    other = replace(whole, silhouette=torch.where(known, whole.silhouette, 1 - whole.silhouette), known=known)
    assert torch.equal(target_of([other], Frame.of(ball, None), side).silhouette, target.silhouette)


def test_a_region_does_not_reach_for_unknown_pixels(ball: Mesh) -> None:
    camera = a_camera(64, 48)
    view = view_of(ball, camera)
    known = torch.ones(48, 64, dtype=torch.bool)
    known[0, 0] = False
    stray = view.silhouette.clone()
    stray[0, 0] = 1.0
    assert Region.around(View(stray, camera, known), ball) == Region.around(view, ball)
