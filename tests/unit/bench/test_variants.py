"""Variants change what they say and nothing else; cases survive being written and read again."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from refine_bench import variants
from refine_bench.cases import Case, CaseSkipped, CaseUnavailable, Plane, Scene, SetInvalid, mesh_of
from refine_bench.export import camera_spec, export_case
from refine_bench.sets.folder import folder_cases
from refine_bench.variants import vary
from refine_engine.cameras.seen import hard_silhouette, silhouette_iou
from refine_engine.cameras.spec import camera_from_spec, read_camera
from refine_engine.scores.scores import SurfacePoints
from refine_engine.values import Camera, Mesh, View

ANGLES = (30.0, 20.0, 1.4)


def scene() -> Scene:
    """A wedge, symmetric about z = 0 only, reconstructed 10 % too large."""
    corners = np.array([(x, y, z) for x in (-0.3, 0.3) for y in (-0.2, 0.2) for z in (-0.4, 0.4)])
    corners[:, 1] += 0.3 * corners[:, 0]
    truth = mesh_of(trimesh.convex.convex_hull(corners).subdivide())
    camera = Camera.look_at(*ANGLES, 60.0, 160, 160)
    view = View(hard_silhouette(truth, camera).float(), camera)
    image = np.zeros((160, 160, 3), np.uint8)
    return Scene(Mesh(truth.vertices * 1.1, truth.faces), view, truth, image)


CASE = Case("wedge", "wedge", scene, plane=Plane((0.0, 0.0, 1.0), 0.0))


def truth_of(varied: Scene) -> Mesh:
    assert isinstance(varied.ground_truth, Mesh)
    return varied.ground_truth


def test_yaw_turns_everything_together() -> None:
    varied = vary(CASE, "yaw")
    turned, given = varied.load(), scene()
    assert silhouette_iou(truth_of(turned), turned.view) > 0.99
    assert silhouette_iou(turned.coarse, turned.view) == pytest.approx(
        silhouette_iou(given.coarse, given.view), abs=0.01
    )
    before, after = truth_of(given).vertices, truth_of(turned).vertices
    assert torch.allclose(before[:, 1], after[:, 1], atol=1e-6)
    assert varied.plane is not None
    normal = torch.tensor(varied.plane.normal)
    angle = float(torch.rad2deg(torch.arccos(normal[2])))
    assert 25.0 <= angle <= 65.0
    mirrored = after - 2 * (after @ normal)[:, None] * normal
    assert float((mirrored[:, None] - after).norm(dim=2).amin(1).max()) < 1e-5
    assert turned.image is None
    assert torch.equal(vary(CASE, "yaw").load().coarse.vertices, turned.coarse.vertices)


def test_small_puts_the_image_somewhere_into_a_photo() -> None:
    small = vary(CASE, "small").load()
    camera = small.view.camera
    assert (camera.width, camera.height) == (1024, 768)
    assert silhouette_iou(truth_of(small), small.view) > 0.97
    rows, columns = (small.view.silhouette > 0.5).nonzero().T
    assert 60 < int(columns.max() - columns.min()) < 260
    assert int(rows.min()) >= 40
    assert torch.equal(small.coarse.vertices, scene().coarse.vertices)


def test_noise_moves_camera_and_outline_a_little() -> None:
    noisy, given = vary(CASE, "noisy").load(), scene()
    assert 0.7 < silhouette_iou(truth_of(noisy), noisy.view) < 0.97
    changed = (noisy.view.silhouette > 0.5) != (given.view.silhouette > 0.5)
    outline = 3.0 * float((given.view.silhouette > 0.5).sum()) ** 0.5  # pixels, roughly
    assert 0.5 * outline < int(changed.sum()) < 3.0 * outline
    azimuth, elevation, distance = spec_of(noisy.view.camera)
    assert 3.0 <= abs(azimuth - ANGLES[0]) <= 6.0
    assert 2.0 <= abs(elevation - ANGLES[1]) <= 4.0
    assert 0.02 <= abs(distance / ANGLES[2] - 1.0) <= 0.05


def spec_of(camera: Camera) -> tuple[float, float, float]:
    spec = camera_spec(camera)
    assert spec["type"] == "look_at"
    return spec["azimuth_degrees"], spec["elevation_degrees"], spec["distance"]


def test_a_camera_is_turned_about_what_it_looks_at() -> None:
    ball = mesh_of(trimesh.creation.icosphere(2, 0.4))
    turned = variants._orbited(Camera.look_at(*ANGLES, 60.0, 96, 96), ball, 0.1, -0.05, 1.03)
    wanted = Camera.look_at(
        ANGLES[0] + np.degrees(0.1), ANGLES[1] + np.degrees(-0.05), ANGLES[2] * 1.03, 60.0, 96, 96
    )
    assert torch.allclose(turned.world_to_camera, wanted.world_to_camera, atol=1e-5)


def test_the_truth_goes_in_with_its_own_silhouette() -> None:
    varied = vary(CASE, "truth").load()
    assert torch.equal(varied.coarse.vertices, truth_of(varied).vertices)
    assert silhouette_iou(varied.coarse, varied.view) == 1.0
    points = replace(scene(), ground_truth=SurfacePoints(scene().coarse.vertices))
    with pytest.raises(CaseSkipped, match="expected a mesh as ground truth"):
        vary(replace(CASE, load=lambda: points), "truth").load()


@pytest.mark.parametrize(
    "variant", ["none", "small"]
)  # a camera that looks at the origin, and one that does not
def test_a_written_case_is_read_as_it_was(variant: str, tmp_path: Path) -> None:
    case = replace(CASE, level="mild", asymmetric=True)
    case = case if variant == "none" else vary(case, variant)
    folder = export_case(case, tmp_path)
    assert folder == tmp_path / "mild" / "wedge"
    (read,) = folder_cases(tmp_path / "mild")
    assert (read.plane, read.asymmetric, read.plane_told) == (CASE.plane, True, False)
    first, again = case.load(), read.load()
    assert torch.equal(first.coarse.vertices, again.coarse.vertices)
    assert torch.equal(first.coarse.faces, again.coarse.faces)
    assert torch.equal(truth_of(first).vertices, truth_of(again).vertices)
    assert torch.allclose(first.view.silhouette, again.view.silhouette, atol=1 / 255)
    camera, other = first.view.camera, again.view.camera
    assert torch.allclose(camera.world_to_camera, other.world_to_camera, atol=1e-5)
    assert (other.fx, other.cy) == pytest.approx((camera.fx, camera.cy), rel=1e-5)
    assert (again.image is None) == (first.image is None)


def test_an_orthographic_camera_is_written_as_one() -> None:
    camera = replace(Camera.look_at(*ANGLES, 60.0, 96, 96), projection="orthographic")
    assert camera_from_spec(read_camera(camera_spec(camera)), 96, 96).projection == "orthographic"


def test_points_may_be_the_truth_and_are_written_again(tmp_path: Path) -> None:
    points = SurfacePoints(torch.rand(40, 3))
    given = replace(CASE, load=partial(replace, scene(), ground_truth=points), plane=None)
    folder = export_case(given, tmp_path)
    (case,) = folder_cases(tmp_path)
    truth = case.load().ground_truth
    assert isinstance(truth, SurfacePoints)
    assert torch.equal(truth.points, points.points)
    assert case.plane is None
    (folder / "gt.xyz").write_text("1 2 3\n4 5\n")
    with pytest.raises(CaseUnavailable, match="expected three numbers a line"):
        case.load()
    (folder / "symmetry.json").write_text('{"normal": [0, 1]}')
    with pytest.raises(SetInvalid, match=r'expected \{"normal"'):
        folder_cases(tmp_path)
