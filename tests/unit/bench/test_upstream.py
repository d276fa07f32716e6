"""The network of our own: its parts do what they say, and its sets are what their levels are called."""

from pathlib import Path

import numpy as np
import pytest
import torch

from refine_bench.cases import Scene
from refine_bench.sets import upstream
from refine_bench.shapes import GENERATORS
from refine_bench.upstream import train
from refine_bench.upstream.network import (
    GRID,
    HALF_SIDE,
    KINDS,
    Code,
    Kind,
    Reconstruction,
    Sight,
    load_network,
    pose_of,
    save_weights,
    weights_of,
)
from refine_bench.upstream.photos import HELD_OUT, KNOWN, LEVELS, Photo, make_object, sight_of, take_photo
from refine_bench.upstream.reconstruct import OCCUPANCY_LEVEL, surface
from refine_engine.cameras.seen import silhouette_iou
from refine_engine.values import Camera, Mesh

LEVEL = float(np.log(OCCUPANCY_LEVEL / (1 - OCCUPANCY_LEVEL)))  # the logit of the surface


def cell_centres() -> torch.Tensor:
    """(40, 40, 40, 3) in the frame of the objects."""
    middles = ((torch.arange(GRID) + 0.5) / GRID * 2 - 1) * HALF_SIDE
    return torch.stack(torch.meshgrid(middles, middles, middles, indexing="ij"), -1)


def volume(mesh: Mesh) -> float:
    """Signed: positive where the faces look outward."""
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("kind", KINDS)
def test_the_network_turns_images_into_a_grid_and_its_weights_are_small(kind: Kind, tmp_path: Path) -> None:
    assert weights_of(kind).stat().st_size < 5_000_000
    network = load_network(kind)
    assert 1_500_000 < sum(p.numel() for p in network.parameters()) < 3_000_000
    sight = Sight(torch.rand(2, 3, 64, 64), torch.rand(2, 5), torch.eye(3, 4).repeat(2, 1, 1))
    logits = network(sight)
    assert logits.shape == (2, GRID, GRID, GRID)
    save_weights(network, tmp_path / "again.npz")
    assert torch.equal(load_network(kind, tmp_path / "again.npz")(sight), logits)
    elsewhere = Sight(sight.images, 1 - sight.poses, 2 * sight.projections)
    assert torch.equal(network(elsewhere), logits) == (kind == "image")


def test_the_channels_of_the_last_layer_are_the_octants_of_a_cell() -> None:
    network = Reconstruction("camera").eval()
    last = network.refine[-1]
    assert isinstance(last, torch.nn.Conv3d)
    assert last.bias is not None
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.arange(8.0))
    logits = network.decode(Code(torch.zeros(1, 192), torch.zeros(1, 32, 10, 10, 10)))[0]
    corner = torch.tensor([[[0.0, 1.0], [2.0, 3.0]], [[4.0, 5.0], [6.0, 7.0]]])
    assert torch.equal(logits, corner.repeat(GRID // 2, GRID // 2, GRID // 2))


def test_the_pose_says_where_the_camera_stood() -> None:
    pose = pose_of(Camera.look_at(30.0, -20.0, 1.6, 60.0, 96, 96))
    a, e = np.radians(30.0), np.radians(-20.0)
    wanted = [np.sin(a), np.cos(a), np.sin(2 * a), np.cos(2 * a), np.sin(e)]
    assert pose.tolist() == pytest.approx(wanted, abs=1e-6)


def test_marching_cubes_put_the_surface_where_the_field_has_it() -> None:
    """An ellipsoid off the middle, of another length along each axis."""
    centre, radii = torch.tensor([0.1, -0.15, 0.05]), torch.tensor([0.35, 0.25, 0.15])
    distance = ((cell_centres() - centre) / radii).norm(dim=-1)
    mesh = surface(20 * (1 - distance) + LEVEL)
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    assert torch.allclose((low + high) / 2, centre, atol=0.01)
    assert torch.allclose((high - low) / 2, radii, atol=0.02)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * float(radii.prod()), rel=0.05)
    assert 2500 < len(mesh.faces) <= 3000


def test_the_network_sees_the_square_around_the_object() -> None:
    image = np.zeros((120, 160, 3), np.uint8)
    silhouette = np.zeros((120, 160), np.bool_)
    silhouette[10:50, 100:120] = True
    image[silhouette] = 255
    camera = Camera.look_at(30.0, 20.0, 1.6, 60.0, 160, 120)
    sight = sight_of(Photo(image, silhouette, camera))
    assert sight.images.shape == (1, 3, 64, 64)
    rows, columns = (sight.images[0, 0] > 0.5).nonzero().T
    assert int(rows.max() - rows.min() + 1) == pytest.approx(64 / 1.1, abs=1.5)
    assert int(columns.max() - columns.min() + 1) == pytest.approx(32 / 1.1, abs=1.5)
    assert float(rows.float().mean()) == pytest.approx(31.5, abs=1.0)
    assert float(columns.float().mean()) == pytest.approx(31.5, abs=1.0)


def test_places_are_looked_up_where_the_camera_sees_them() -> None:
    """The photo of a table: the corners of its box lie on the sides of the square that the network sees."""
    shape = make_object("table", "test")
    sight = sight_of(take_photo(shape, np.random.default_rng(0), shifted=False))
    vertices = torch.tensor(np.asarray(shape.vertices), dtype=torch.float32)
    seen = torch.cat([vertices, torch.ones(len(vertices), 1)], 1) @ sight.projections[0].T
    square = seen[:, :2] / seen[:, 2:]
    assert float(square.abs().max()) == pytest.approx(1 / 1.1, abs=0.02)
    network = Reconstruction("camera").eval()
    assert network.look.bias is not None
    with torch.no_grad():
        network.look.weight.zero_()
        network.look.bias.copy_(torch.arange(32.0))
        places = network.encode(sight).places
    assert places is not None
    assert torch.allclose(places[0, :, 3, 4, 5], torch.arange(32.0))


@pytest.mark.parametrize("kind", KINDS)
def test_training_learns_and_writes_what_can_be_loaded(
    kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "OBJECT_KINDS", ("table", "assembly"))
    monkeypatch.setattr(train, "BATCH", 4)
    examples = train.make_examples(objects=1, photos=2)
    assert examples.images.shape == (2, 2, 3, 64, 64)
    losses = [loss for _, loss, _ in train.train(kind, examples, steps=12)]
    assert losses[-1] < 0.7 * losses[0]
    train.main([kind, "--objects", "1", "--steps", "1", "-o", str(tmp_path / "weights.npz")])
    load_network(kind, tmp_path / "weights.npz")


def test_a_seed_names_a_set_and_levels_are_what_they_are_called() -> None:
    cases = upstream.upstream_cases(seed=5, count=5)
    assert [case.level for case in cases] == [level for level in LEVELS for _ in range(5)]
    assert {case.name.rsplit("_", 2)[0] for case in cases if case.level == "strong"} == set(HELD_OUT)
    assert set(HELD_OUT) | set(KNOWN) == set(GENERATORS)
    assert not set(HELD_OUT) & set(train.OBJECT_KINDS)
    first, again = cases[0].load(), upstream.upstream_cases(seed=5, count=1)[0].load()
    other = upstream.upstream_cases(seed=6, count=1)[0].load()
    assert torch.equal(first.coarse.vertices, again.coarse.vertices)
    assert first.coarse.vertices.shape != other.coarse.vertices.shape or not torch.equal(
        first.coarse.vertices, other.coarse.vertices
    )


@pytest.mark.parametrize(("level", "kind"), [*((level, "camera") for level in LEVELS), ("none", "image")])
def test_a_case_has_its_truth_its_photo_and_a_mesh_that_resembles_it(level: str, kind: Kind) -> None:
    case = next(case for case in upstream.upstream_cases(3, 1, kind) if case.level == level)
    scene: Scene = case.load()
    assert isinstance(scene.ground_truth, Mesh)
    assert silhouette_iou(scene.ground_truth, scene.view) == 1.0
    assert silhouette_iou(scene.coarse, scene.view) > 0.25
    assert len(scene.coarse.faces) <= 3000
    assert scene.network == kind
    assert scene.image is not None
    assert scene.image.shape == (224, 224, 3)
    background = scene.image[scene.view.silhouette.numpy() < 0.5].astype(float)
    assert (background.std(0).max() > 5.0) == (level == "mild")  # clouds, or the plain wall of the studio


def test_objects_are_closed_of_unit_length_and_symmetric() -> None:
    for kind in ("assembly", "table"):
        shape = make_object(kind, "test")
        assert shape.is_watertight
        assert shape.extents.max() == pytest.approx(1.0)
        assert shape.bounds[0, 2] == pytest.approx(-shape.bounds[1, 2], abs=1e-6)
    photo = take_photo(make_object("table", "test"), np.random.default_rng(0), shifted=False)
    assert photo.image.shape == (*photo.silhouette.shape, 3)
