"""The mirror plane that is found on a mesh, wherever it is."""

import math

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from refine_engine.method.config import RefineConfig
from refine_engine.method.planes import find_mirror_plane, longest_side, mirror_plane
from refine_engine.values import Mesh


def boxes(*size_and_place: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """Separate boxes, each given by its size and its centre."""
    parts = []
    for size, place in size_and_place:
        box = trimesh.creation.box(size)
        box.apply_translation(place)
        parts.append(box)
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    vertices, faces = np.array(whole.vertices, np.float32), np.array(whole.faces, np.int64)
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


@pytest.fixture
def plane() -> Mesh:
    """A body, a fin at its end and two wings: z = 0 is its only mirror plane."""
    return boxes(
        ((1.0, 0.12, 0.14), (0.0, 0.0, 0.0)),
        ((0.16, 0.3, 0.04), (0.42, 0.2, 0.0)),
        ((0.25, 0.04, 0.4), (-0.1, 0.0, 0.26)),
        ((0.25, 0.04, 0.4), (-0.1, 0.0, -0.26)),
    )


@pytest.fixture
def scrap() -> Mesh:
    """A bent wire: no plane mirrors one half on the other."""
    return boxes(
        ((1.0, 0.05, 0.05), (0.5, 0.0, 0.0)),
        ((0.05, 0.7, 0.05), (1.0, 0.35, 0.0)),
        ((0.05, 0.05, 0.9), (1.0, 0.7, 0.45)),
        ((0.5, 0.05, 0.05), (1.25, 0.7, 0.9)),
    )


def rotation(seed: int) -> Tensor:
    """Any rotation, as a matrix."""
    random = torch.Generator().manual_seed(seed)
    q: Tensor = torch.linalg.qr(torch.randn(3, 3, generator=random))[0]
    proper: Tensor = q * torch.linalg.det(q)
    return proper


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_it_is_found_in_any_direction_and_unit(plane: Mesh, seed: int, unit: float) -> None:
    turn, shift = rotation(seed), unit * torch.tensor([0.3, -2.0, 1.0])
    found = find_mirror_plane(Mesh(unit * plane.vertices @ turn.T + shift, plane.faces))
    assert found is not None
    n = turn[:, 2]  # of what was z = 0
    cos = float(found.normal @ n)
    assert abs(cos) > math.cos(math.radians(2))
    sign = 1.0 if cos > 0 else -1.0
    # through the middle of the object: where the normals differ a little, far from the origin matters
    assert sign * (found.offset - float(found.normal @ shift)) == pytest.approx(0.0, abs=0.02 * unit)
    assert found.error is not None
    assert found.error < 0.02


def test_a_world_axis_is_taken_exactly(plane: Mesh) -> None:
    """Of a mesh that is only nearly symmetric, whose best plane is a little off it."""
    random = torch.Generator().manual_seed(0)
    noisy = plane.vertices + 0.01 * torch.randn(plane.vertices.shape, generator=random)
    found = find_mirror_plane(Mesh(noisy, plane.faces))
    assert found is not None
    assert found.normal.tolist() == [0.0, 0.0, 1.0]
    assert found.offset == pytest.approx(0.0, abs=0.02)


def test_of_several_axes_the_papers_comes_first() -> None:
    """A box has three mirror planes."""
    found = find_mirror_plane(boxes(((1.0, 0.5, 0.3), (0.0, 0.0, 0.4))))
    assert found is not None
    assert found.normal.tolist() == [0.0, 0.0, 1.0]
    assert found.offset == pytest.approx(0.4, abs=0.01)


def test_an_object_without_symmetry_has_none(scrap: Mesh) -> None:
    assert find_mirror_plane(scrap) is None
    assert find_mirror_plane(Mesh(scrap.vertices @ rotation(0).T, scrap.faces)) is None


def test_the_config_decides_whether_it_is_searched_for(scrap: Mesh, plane: Mesh) -> None:
    assert mirror_plane(plane, RefineConfig(symmetry="none")) is None
    assert mirror_plane(scrap, RefineConfig()) is None
    given = mirror_plane(
        scrap, RefineConfig(symmetry="plane", symmetry_normal=(0, 3, 4), symmetry_offset=0.2)
    )
    assert given is not None
    torch.testing.assert_close(given.normal, torch.tensor([0.0, 0.6, 0.8]))
    assert given.offset == 0.2
    assert given.error is None
    placed = mirror_plane(scrap, RefineConfig(symmetry="plane"))
    assert placed is not None
    assert placed.error is not None
    assert placed.error > 0.06


def test_longest_side_of_what_faces_use() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [50, 0, 0]])
    assert longest_side(Mesh(vertices, torch.tensor([[0, 1, 2]]))) == 3.0
