"""Every published layout is read as its publishers describe it, and what is missing is named.

The trees are small, in the published layouts, and drawn without the code of the loaders.
"""

import json
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image

from refine_bench.asymmetry import ASYMMETRIC_FROM, image_asymmetry
from refine_bench.cases import Case, CaseSkipped, CaseUnavailable, Plane, SetInvalid, mesh_of
from refine_bench.coarse_files import CoarseFolder, Frame
from refine_bench.rerender import rerender
from refine_bench.sets.folder import folder_cases
from refine_bench.sets.odds import Odds
from refine_bench.sets.pix3d import Pix3D
from refine_bench.sets.shapenet import ShapeNet, camera_of_line, metadata_line
from refine_bench.shapes import make_shape
from refine_engine.cameras.seen import hard_silhouette, silhouette_iou
from refine_engine.scores.scores import sample_surface
from refine_engine.values import Camera, Mesh

Floats = NDArray[np.float64]
SYNSET, MODEL = "02958343", "1a2b3c"


def wedge() -> trimesh.Trimesh:
    """A closed shape without any symmetry, about ShapeNet's size."""
    corners = np.array(
        [
            [-0.3, -0.15, -0.2], [0.35, -0.15, -0.2], [0.35, -0.15, 0.1],
            [-0.3, -0.15, 0.2], [-0.2, 0.25, -0.15], [-0.1, 0.1, 0.12],
        ]
    )  # fmt: skip
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(corners).subdivide()
    return hull


def write_mask(path: Path, mesh: Mesh, camera: Camera) -> None:
    """RGBA with the object in alpha."""
    mask = hard_silhouette(mesh, camera).numpy().astype(np.uint8) * 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.stack([mask] * 4, -1)).save(path)


def write_mesh(path: Path, shape: trimesh.Trimesh) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    shape.export(path)
    return path


def make_shapenet(root: Path, lines: int = 24) -> tuple[Path, Path, Path]:
    """Renderings, models and coarse meshes of one car; only image 03 is drawn. The camera is the one that
    the sources of the layout describe, written here without the loader's code."""
    shape = wedge()
    write_mesh(root / "models" / SYNSET / MODEL / "model.obj", shape)
    write_mesh(root / "coarse" / SYNSET / f"{MODEL}.off", shape)
    folder = root / "renderings" / SYNSET / MODEL / "rendering"
    azimuth, elevation, distance = 287.5, 27.0, 1.75 * 0.8
    a, e = np.radians(azimuth), np.radians(elevation)
    position = distance * np.array([np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)])
    camera = camera_at(position, focal=137 * 35 / 32, side=137)
    write_mask(folder / "03.png", mesh_of(shape), camera)
    line = f"{azimuth} {elevation} 0 {distance / 1.75} 25"
    other = "10.0 25.0 0 0.7 25"
    rows = [line if number == 3 else other for number in range(lines)]
    (folder / "rendering_metadata.txt").write_text("\n".join(rows) + "\n")
    (folder / "renderings.txt").write_text("\n".join(f"{k:02}.png" for k in range(24)) + "\n")
    return root / "renderings", root / "models", root / "coarse"


def camera_at(position: Floats, focal: float, side: int) -> Camera:
    """Looks from `position` at the origin, up +Y."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return Camera(torch.from_numpy(matrix), focal, focal, side / 2, side / 2, side, side)


def make_pix3d(root: Path) -> tuple[Path, Path]:
    """One chair as Pix3D has it, and an occluded one; the mask is drawn by the README's own projection."""
    shape = wedge()
    write_mesh(root / "set" / "model" / "chair" / "some_chair" / "model.obj", shape)
    write_mesh(root / "coarse" / "chair" / "0007.obj", shape)
    angle = np.radians(35.0)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    translation = np.array([0.1, -0.05, 1.6])
    width, height, focal_mm = 480, 360, 35.0
    # u leftwards and v upwards from the middle: K (R x + t) with f in pixels of a 32 mm wide sensor
    points = trimesh.sample.sample_surface(shape, 1_000_000, seed=0)[0] @ rotation.T + translation
    uv = points[:, :2] / points[:, 2:] * focal_mm / 32 * width
    column = np.floor(width / 2 - uv[:, 0]).astype(int)
    row = np.floor(height / 2 - uv[:, 1]).astype(int)
    mask = np.zeros((height, width), np.uint8)
    mask[row, column] = 255
    (root / "set" / "mask" / "chair").mkdir(parents=True)
    Image.fromarray(mask).save(root / "set" / "mask" / "chair" / "0007.png")
    record = {
        "img": "img/chair/0007.png", "category": "chair", "img_size": [width, height],
        "mask": "mask/chair/0007.png", "model": "model/chair/some_chair/model.obj",
        "rot_mat": rotation.tolist(), "trans_mat": translation.tolist(), "focal_length": focal_mm,
        "cam_position": [0, 0, 0], "inplane_rotation": 0.0,
        "truncated": False, "occluded": False, "slightly_occluded": False,
    }  # fmt: skip
    hidden = {**record, "img": "img/chair/0008.png", "occluded": True}
    (root / "set" / "pix3d.json").write_text(json.dumps([record, hidden]))
    return root / "set", root / "coarse"


def make_odds(root: Path) -> tuple[Path, Path]:
    """One object in two domains; the second image lacks its camera."""
    shape, camera = wedge(), Camera.look_at(30.0, 10.0, 1.0, 60.0, 96, 96)
    write_mesh(root / "set" / "ground_truth" / "Some_Can.obj", shape)
    for domain in ("OOWL", "OWILD"):
        write_mask(root / "set" / "examples" / f"{domain}_Some_Can_090.png", mesh_of(shape), camera)
        write_mesh(root / "coarse" / f"{domain}_Some_Can_090.obj", shape)
    spec = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 10, "distance": 1.0}
    (root / "set" / "cameras.json").write_text(json.dumps({"OOWL_Some_Can_090": spec}))
    return root / "set", root / "coarse"


def make_folder(root: Path, names: tuple[str, ...]) -> Path:
    """Cases of one's own: the coarse mesh is the truth, larger and moved."""
    shape, camera = wedge(), Camera.look_at(30.0, 20.0, 1.2, 60.0, 96, 96)
    coarse = shape.copy()
    coarse.vertices = coarse.vertices * 1.15 + [0.02, 0.0, -0.01]
    spec = {"type": "look_at", "azimuth_degrees": 30, "elevation_degrees": 20, "distance": 1.2}
    for name in names:
        write_mesh(root / name / "gt.obj", shape)
        write_mesh(root / name / "coarse.obj", coarse)
        write_mask(root / name / "silhouette.png", mesh_of(shape), camera)
        (root / name / "camera.json").write_text(json.dumps(spec))
    return root


def shapenet(
    root: Path, categories: Collection[str] = (), instances: Collection[str] = (), asymmetric: bool = False
) -> ShapeNet:
    renderings, models, coarse = make_shapenet(root)
    return ShapeNet(renderings, models, CoarseFolder(coarse), 3, categories, instances, asymmetric)


def only(cases: list[Case]) -> Case:
    (case,) = cases
    return case


def test_shapenet_camera_draws_the_published_image(tmp_path: Path) -> None:
    case = only(shapenet(tmp_path).cases())
    scene = case.load()
    assert (case.name, case.category) == (f"car_{MODEL}_03", "car")
    assert isinstance(scene.ground_truth, Mesh)
    assert silhouette_iou(scene.ground_truth, scene.view) > 0.99
    assert scene.view.camera.fx == pytest.approx(137 * 35 / 32)


def test_shapenet_metadata_lines_are_read_as_written() -> None:
    camera = camera_of_line(metadata_line(33.0, 12.0, 1.4), 137, 137)
    fov = 2 * np.degrees(np.arctan(16 / 35))
    expected = Camera.look_at(33.0, 12.0, 1.4, fov, 137, 137)
    assert torch.allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-5)


@pytest.mark.parametrize(
    ("line", "message"),
    [("1 2 3", "expected azimuth, elevation"), ("10 25 4 0.7 25", "in-plane rotation of 0")],
)
def test_shapenet_metadata_of_another_kind_is_refused(line: str, message: str) -> None:
    with pytest.raises(CaseUnavailable, match=message):
        camera_of_line(line, 137, 137)


@pytest.mark.parametrize(
    "missing",
    [
        f"renderings/{SYNSET}/{MODEL}/rendering/03.png",
        f"renderings/{SYNSET}/{MODEL}/rendering/rendering_metadata.txt",
        f"models/{SYNSET}/{MODEL}/model.obj",
    ],
)
def test_shapenet_names_the_missing_file(missing: str, tmp_path: Path) -> None:
    case = only(shapenet(tmp_path).cases())
    (tmp_path / missing).unlink()
    with pytest.raises(CaseUnavailable, match=missing):
        case.load()


def test_shapenet_half_downloaded_metadata_and_missing_coarse_mesh(tmp_path: Path) -> None:
    case = only(shapenet(tmp_path).cases())
    (tmp_path / "coarse" / SYNSET / f"{MODEL}.off").unlink()
    with pytest.raises(CaseUnavailable, match=rf"coarse mesh of {SYNSET}/{MODEL} in .*OccNet"):
        case.load()
    make_shapenet(tmp_path, lines=2)
    with pytest.raises(CaseUnavailable, match="at least 4 lines"):
        case.load()


def test_shapenet_split_names_what_was_not_rendered(tmp_path: Path) -> None:
    split = [f"{SYNSET}/{MODEL}", f"{SYNSET}/gone"]
    first, second = shapenet(tmp_path, instances=split).cases()
    assert first.load().coarse.vertices.shape[1] == 3
    with pytest.raises(CaseUnavailable, match="gone"):
        second.load()


def test_shapenet_wrong_folders_are_refused(tmp_path: Path) -> None:
    good = shapenet(tmp_path)
    with pytest.raises(
        SetInvalid, match=r"expected synset folders such as 02691156 in .*, got coarse, models"
    ):
        ShapeNet(tmp_path, good.models, good.coarse).cases()
    with pytest.raises(SetInvalid, match="which does not exist"):
        ShapeNet(tmp_path / "nowhere", good.models, good.coarse).cases()
    with pytest.raises(SetInvalid, match="expected categories among airplane"):
        shapenet(tmp_path, categories=["teapot"]).cases()


def test_shapenet_asym_takes_the_asymmetric_models(tmp_path: Path) -> None:
    case = only(shapenet(tmp_path, asymmetric=True).cases())
    assert case.asymmetric  # the ablation compares both lambda_B on it
    case.load()
    write_mesh(tmp_path / "models" / SYNSET / MODEL / "model.obj", make_shape("car", 0))
    with pytest.raises(CaseSkipped, match="not in ShapeNetAsym"):
        case.load()


def test_image_asymmetry_tells_a_corner_sofa_from_a_sofa() -> None:
    assert image_asymmetry(mesh_of(make_shape("sofa", 0))) < ASYMMETRIC_FROM / 4
    assert image_asymmetry(mesh_of(make_shape("corner_sofa", 0))) > ASYMMETRIC_FROM


def test_rerendered_models_are_read_by_the_shapenet_loader(tmp_path: Path) -> None:
    _, models, coarse = make_shapenet(tmp_path)
    (models / SYNSET / "broken").mkdir()
    (models / SYNSET / "broken" / "model.obj").write_bytes(b"v 1 2")
    target = tmp_path / "again"
    (problem,) = rerender(models, target, views=2, seed=5)
    assert problem.startswith(f"{SYNSET}/broken: ")
    written = target / SYNSET / MODEL / "rendering" / "01.png"
    first = written.read_bytes()
    scene = only(
        [c for c in ShapeNet(target, models, CoarseFolder(coarse), view=1).cases() if MODEL in c.name]
    ).load()
    assert isinstance(scene.ground_truth, Mesh)
    assert silhouette_iou(scene.ground_truth, scene.view) > 0.97
    rerender(models, tmp_path / "third", views=2, seed=5)
    assert (tmp_path / "third" / SYNSET / MODEL / "rendering" / "01.png").read_bytes() == first
    rerender(models, tmp_path / "other", views=2, seed=6)
    assert (tmp_path / "other" / SYNSET / MODEL / "rendering" / "01.png").read_bytes() != first


def test_pix3d_camera_draws_the_mask(tmp_path: Path) -> None:
    root, coarse = make_pix3d(tmp_path)
    case = only(Pix3D(root, CoarseFolder(coarse)).cases())  # the occluded one is left out
    scene = case.load()
    assert (case.name, case.plane) == ("chair_0007", Plane((1.0, 0.0, 0.0)))
    assert isinstance(scene.ground_truth, Mesh)
    assert silhouette_iou(scene.ground_truth, scene.view) > 0.98


def test_pix3d_names_what_is_missing(tmp_path: Path) -> None:
    root, coarse = make_pix3d(tmp_path)
    case = only(Pix3D(root, CoarseFolder(coarse)).cases())
    for part in ("model/chair/some_chair/model.obj", "mask/chair/0007.png"):
        (root / part).unlink()
        with pytest.raises(CaseUnavailable, match=part):
            case.load()
    with pytest.raises(SetInvalid, match=r"pix3d\.json, got none"):
        Pix3D(coarse, CoarseFolder(coarse)).cases()
    (root / "pix3d.json").write_text('[{"img": ')
    with pytest.raises(SetInvalid, match="a partial download"):
        Pix3D(root, CoarseFolder(coarse)).cases()
    (root / "pix3d.json").write_text(json.dumps([{"img": "img/bed/1.png"}]))
    with pytest.raises(SetInvalid, match="expected category, img_size"):
        Pix3D(root, CoarseFolder(coarse)).cases()


def test_odds_finds_files_by_name_and_names_what_is_missing(tmp_path: Path) -> None:
    root, coarse = make_odds(tmp_path)
    first, second = Odds(root, CoarseFolder(coarse)).cases()
    assert (first.name, first.category, second.category) == ("OOWL_Some_Can_090", "OOWL", "OWILD")
    scene = first.load()
    assert isinstance(scene.ground_truth, Mesh)
    assert silhouette_iou(scene.ground_truth, scene.view) > 0.99
    with pytest.raises(CaseUnavailable, match="a camera for OWILD_Some_Can_090"):
        second.load()
    (root / "ground_truth" / "Some_Can.obj").unlink()
    with pytest.raises(CaseUnavailable, match=r"ground truth Some_Can\.obj"):
        Odds(root, CoarseFolder(coarse), ["OOWL"]).cases()[0].load()
    (root / "cameras.json").unlink()
    with pytest.raises(SetInvalid, match="a camera for each image"):
        Odds(root, CoarseFolder(coarse)).cases()


def test_a_folder_of_ones_own_needs_no_ground_truth(tmp_path: Path) -> None:
    root = make_folder(tmp_path, ("one", "two"))
    (root / "one" / "gt.obj").unlink()
    (root / "two" / "coarse.obj").unlink()
    first, second = folder_cases(root)
    assert first.load().ground_truth is None
    with pytest.raises(CaseUnavailable, match=r"two/coarse\.obj"):
        second.load()
    with pytest.raises(SetInvalid, match="expected folders with"):
        folder_cases(root / "one")


@pytest.mark.parametrize(
    "name",
    [
        f"{SYNSET}/{MODEL}.off",  # OccNet
        f"{SYNSET}/{MODEL}/rendering/03.obj",  # Pixel2Mesh
        f"{SYNSET}/{MODEL}/rendering/03.3.obj",  # its PyTorch port
        f"{MODEL}AtlasnetReconstruction.ply",  # AtlasNet
        f"{MODEL}.glb",
    ],
)
def test_coarse_meshes_are_found_under_the_networks_names(name: str, tmp_path: Path) -> None:
    path = write_mesh(tmp_path / name, wedge())
    assert CoarseFolder(tmp_path).find(SYNSET, MODEL, "03") == path


@pytest.mark.parametrize("frame", ["unit_box", "unit_ball", "pixel2mesh"])
def test_coarse_meshes_come_home_from_the_networks_frames(frame: Frame, tmp_path: Path) -> None:
    """The truth written in a network's frame is read as the truth."""
    shape = wedge()
    shape.vertices = shape.vertices * 0.8 + [0.1, 0.2, -0.3]
    truth, camera = mesh_of(shape), Camera.look_at(40.0, 25.0, 1.4, 50.0, 64, 64)
    moved = shape.copy()
    if frame == "unit_box":
        moved.vertices = (shape.vertices - shape.bounds.mean(0)) / shape.extents.max()
    elif frame == "unit_ball":
        points = sample_surface(np.asarray(shape.triangles), 100_000, np.random.default_rng(3))
        centre = points.mean(0)
        moved.vertices = (shape.vertices - centre) / np.linalg.norm(points - centre, axis=1).max()
    else:
        matrix = camera.world_to_camera.numpy()
        opencv = shape.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        moved.vertices = opencv * [1.0, -1.0, -1.0] / 1.75
    write_mesh(tmp_path / "car" / "x.off", moved)
    folder = CoarseFolder(tmp_path, frame)
    read = folder.load("car", "x", "00", camera, truth)
    assert signature(read) == pytest.approx(signature(truth), abs=0.01 if frame == "unit_ball" else 1e-5)
    if frame != "pixel2mesh":
        with pytest.raises(CaseUnavailable, match="a ground truth to place"):
            folder.load("car", "x", "00", camera, None)


def signature(mesh: Mesh) -> Floats:
    """A number per triangle from its centre, in an order that does not depend on the file format."""
    centres = mesh.vertices[mesh.faces].mean(1).double().numpy()
    return np.asarray(np.sort(centres @ [1.0, 0.31, 0.17]))
