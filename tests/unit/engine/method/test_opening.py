"""Which faces and pixels no motion explains, on flat grids seen straight on."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from refine_engine.method.config import Opening
from refine_engine.method.opening import find_outside, find_unexplained
from refine_engine.method.views import Frame, Region, Target
from refine_engine.values import Camera, Mesh, View

SIDE = 100
CAMERA = Camera(
    torch.diag(torch.ones(4)) + torch.tensor([[0.0] * 4, [0.0] * 4, [0.0, 0, 0, 2], [0.0] * 4]),
    fx=80.0, fy=80.0, cx=50.0, cy=50.0, width=SIDE, height=SIDE, projection="orthographic",
)  # fmt: skip


def sheet(cells: int = 16) -> Mesh:
    """The unit square about the origin in z = 0, two faces a cell: 80 of the 100 pixels, from 10 to 90."""
    at = torch.linspace(-0.5, 0.5, cells + 1)
    y, x = torch.meshgrid(at, at, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], 2).reshape(-1, 3)
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).reshape(-1)
    down, right = corner + cells + 1, corner + 1
    faces = torch.cat([torch.stack([corner, right, down], 1), torch.stack([right, down + 1, down], 1)])
    return Mesh(vertices, faces)


def square(image: Tensor, low: int, high: int, value: float) -> Tensor:
    image[low:high, low:high] = value
    return image


def target_of(silhouette: Tensor, mesh: Mesh) -> Target:
    view = View(silhouette, CAMERA)
    return Target.of([view], [Region.whole(CAMERA)], Frame.of(mesh, None), SIDE)


def centres(mesh: Mesh) -> Tensor:
    """Of the faces, in pixels."""
    return 80 * mesh.vertices[mesh.faces].mean(1)[:, :2] + 50


def test_a_web_over_a_hole_is_outside() -> None:
    """The hole is 20 of 80 pixels wide: all faces inside it go, and none elsewhere."""
    mesh = sheet()
    silhouette = square(square(torch.zeros(SIDE, SIDE), 10, 90, 1.0), 40, 60, 0.0)
    outside = find_outside(mesh.vertices, mesh.faces, target_of(silhouette, mesh), Opening())
    from_middle = (centres(mesh) - 50).abs().amax(1)
    assert outside[from_middle < 8].all()
    assert not outside[from_middle > 11].any()


def test_a_hole_as_shallow_as_an_outlines_error_is_none() -> None:
    """Three pixels wide, so nowhere deeper than two, a fortieth of the object."""
    mesh = sheet()
    silhouette = square(torch.zeros(SIDE, SIDE), 10, 90, 1.0)
    silhouette[20:80, 49:52] = 0.0
    target = target_of(silhouette, mesh)
    assert not find_outside(mesh.vertices, mesh.faces, target, Opening()).any()
    assert find_outside(mesh.vertices, mesh.faces, target, Opening(depth=0.01, outline_px=0.0)).any()


def test_a_thin_outline_error_is_not_outside() -> None:
    """A silhouette that is a pixel smaller than the mesh on every side, over faces of half a pixel."""
    mesh = sheet(160)
    target = target_of(square(torch.zeros(SIDE, SIDE), 11, 89, 1.0), mesh)
    for opening in (Opening(), Opening(outline_px=0.0)):  # too near, and not deep enough
        assert not find_outside(mesh.vertices, mesh.faces, target, opening).any()
    assert find_outside(mesh.vertices, mesh.faces, target, Opening(outline_px=0.0, depth=0.01)).any()


def test_a_face_that_reaches_in_is_not_outside() -> None:
    """Two faces of the whole square, of each of which a hole takes a fifth."""
    mesh = sheet(1)
    silhouette = square(square(torch.zeros(SIDE, SIDE), 10, 90, 1.0), 32, 68, 0.0)
    target = target_of(silhouette, mesh)
    assert not find_outside(mesh.vertices, mesh.faces, target, Opening()).any()


def test_never_are_all_faces_outside() -> None:
    mesh = sheet()
    silhouette = square(torch.zeros(SIDE, SIDE), 0, 6, 1.0)
    assert not find_outside(mesh.vertices, mesh.faces, target_of(silhouette, mesh), Opening()).any()


def test_one_view_is_enough() -> None:
    mesh = sheet()
    whole = square(torch.zeros(SIDE, SIDE), 10, 90, 1.0)
    holed = square(whole.clone(), 40, 60, 0.0)
    one, other = target_of(whole, mesh), target_of(holed, mesh)
    both = replace(
        one,
        silhouette=torch.cat([one.silhouette, other.silhouette]),
        known=one.known.repeat(2, 1, 1),
        world_to_camera=one.world_to_camera.repeat(2, 1, 1),
        intrinsics=one.intrinsics.repeat(2, 1),
    )
    seen = [find_outside(mesh.vertices, mesh.faces, target, Opening()) for target in (other, both)]
    assert torch.equal(*seen)
    assert seen[0].any()


def test_what_is_beyond_the_image_is_not_background() -> None:
    """The right half of the object is not in the picture, and stays."""
    mesh = sheet()
    target = target_of(square(torch.zeros(SIDE, SIDE), 10, 90, 1.0), mesh)
    known = target.known.clone()
    known[:, :, 50:] = 0
    cut = replace(target, silhouette=target.silhouette * known, known=known)
    assert not find_outside(mesh.vertices, mesh.faces, cut, Opening()).any()


@pytest.mark.parametrize("lost", [True, False], ids=["a lost part", "a web"])
def test_unexplained_is_where_the_mesh_covers_deep_background(lost: bool) -> None:
    """The mesh covers 80 pixels. A hole of 20 x 20 in it is farther than 4; a part beside it does pull."""
    mesh = sheet()
    if lost:
        mesh = Mesh(mesh.vertices * torch.tensor([0.5, 1.0, 1.0]), mesh.faces)  # columns 30 to 70
    silhouette = square(torch.zeros(SIDE, SIDE), 10, 90, 1.0)
    if not lost:
        silhouette = square(silhouette, 40, 60, 0.0)
    frame = Frame(torch.zeros(3), 1.0)
    target = Target.of([View(silhouette, CAMERA)], [Region.whole(CAMERA)], frame, SIDE)
    unexplained = find_unexplained(mesh.vertices, mesh.faces, target, 0.05)[0]
    expected = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    if not lost:
        expected[40:60, 40:60] = True
    assert not unexplained[~expected].any()
    assert float(unexplained.sum()) >= 0.95 * float(expected.sum())


def test_a_thin_difference_is_explained() -> None:
    """Two pixels on every side; a twentieth of 80 would be four."""
    mesh = sheet()
    target = target_of(square(torch.zeros(SIDE, SIDE), 12, 88, 1.0), mesh)
    assert not find_unexplained(mesh.vertices, mesh.faces, target, 0.05).any()


def test_what_is_unknown_needs_no_explanation() -> None:
    """A third of the sheet is hidden, or cut off by the border of the image: the rest agrees."""
    mesh = sheet()
    known = torch.ones(SIDE, SIDE, dtype=torch.bool)
    known[:, 60:] = False
    silhouette = square(torch.zeros(SIDE, SIDE), 10, 90, 1.0) * known
    whole, frame = Region.whole(CAMERA), Frame.of(mesh, None)
    hidden = Target.of([View(silhouette, CAMERA, known)], [whole], frame, SIDE)
    cut_off = Target.of([View(silhouette[:, :60].clone(), replace(CAMERA, width=60))], [whole], frame, SIDE)
    for target in (hidden, cut_off):
        assert not find_unexplained(mesh.vertices, mesh.faces, target, 0.05).any()
        assert not find_outside(mesh.vertices, mesh.faces, target, Opening()).any()
    assert find_unexplained(mesh.vertices, mesh.faces, target_of(silhouette, mesh), 0.05).any()
