"""What decimation has to keep: the surface, its topology, its thin parts, and where everything went."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from surfaces import grid, sphere, tube

from refine_engine.proxy.collapse import Floats, Ints
from refine_engine.proxy.decimate import CLUSTERS, decimate


def uses_of_edges(faces: Ints) -> Ints:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.asarray(np.unique(edges, axis=0, return_counts=True)[1])


def volume(vertices: Floats, faces: Ints) -> float:
    return float(np.linalg.det(vertices[faces]).sum() / 6)


def boundary(vertices: Floats, faces: Ints) -> NDArray[np.float64]:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    distinct, uses = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(vertices[np.unique(distinct[uses == 1])])


@pytest.mark.parametrize("count", [12_000, CLUSTERS + 20_000])
def test_a_closed_surface_stays_closed_and_as_large(count: int) -> None:
    """With the grid before collapse, and without it."""
    vertices, faces = sphere(count)
    small = decimate(vertices, faces, 1000)
    assert len(small.vertices) == 1000
    assert (uses_of_edges(small.faces) == 2).all()
    assert len(small.vertices) - len(uses_of_edges(small.faces)) + len(small.faces) == 2
    assert volume(small.vertices, small.faces) == pytest.approx(volume(vertices, faces), rel=0.01)
    assert np.abs(np.linalg.norm(small.vertices, axis=1) - 0.5).max() < 0.003


def test_every_vertex_knows_what_it_became() -> None:
    vertices, faces = sphere(40_000)
    small = decimate(vertices, faces, 1000)
    assert (np.unique(small.vertex_of) == np.arange(1000)).all()
    away = np.linalg.norm(vertices - small.vertices[small.vertex_of], axis=1)
    spacing = cKDTree(small.vertices).query(small.vertices, 2)[0][:, 1].mean()
    assert away.max() < 3 * spacing


def test_flat_parts_keep_even_triangles_and_their_border() -> None:
    """They must be able to bend: quadrics alone would leave two triangles."""
    vertices, faces = grid(120, 120)
    small = decimate(vertices, faces, 900)
    assert len(small.vertices) == 900
    corners = small.vertices[small.faces]
    lengths = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=2)
    assert np.quantile(lengths, 0.99) < 4 * np.quantile(lengths, 0.01)
    area = (
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        / 2
    )
    assert area == pytest.approx(1.0, abs=0.01)
    edge = boundary(small.vertices, small.faces)[:, :2]
    assert np.minimum(edge, 1 - edge).min(1).max() < 0.01


def test_thin_parts_stay() -> None:
    """A rod that is much thinner than the edges of the proxy are long."""
    ball, of_ball = sphere(12_000)
    rod, of_rod = tube(0.01, 300, 12)
    vertices = np.concatenate([ball, rod + np.array([0.6, 0, 0])])
    small = decimate(vertices, np.concatenate([of_ball, of_rod + len(ball)]), 800)
    far = small.vertices[:, 0] > 0.6 + 1e-3
    assert small.vertices[:, 0].max() > 1.59
    thickness = np.hypot(small.vertices[far, 1], small.vertices[far, 2])
    assert 0.005 < thickness[1:-1].mean() < 0.015


def test_two_sheets_in_one_cell_stay_apart() -> None:
    one, faces = grid(200, 200)
    small = decimate(
        np.concatenate([one, one + np.array([0, 0, 1e-3])]), np.concatenate([faces, faces + len(one)]), 1000
    )
    assert set(np.unique(small.vertices[:, 2].round(9))) == {0.0, 1e-3}
    assert (np.ptp(small.vertices[small.faces][..., 2], axis=1) < 1e-9).all()


def test_of_very_many_pieces_the_largest_are_left() -> None:
    """Leaves that collapse cannot make fewer: those that are left stand for those near them."""
    rng = np.random.default_rng(0)
    size = np.where(np.arange(12_000) < 500, 0.02, 0.005)[:, None, None]
    corners = rng.random((12_000, 1, 3)) + size * rng.random((12_000, 3, 3))
    small = decimate(corners.reshape(-1, 3), np.arange(36_000).reshape(-1, 3), 1000)
    assert 1900 < len(small.vertices) <= 2000
    assert len(small.faces) == len(small.vertices) / 3
    assert (np.unique(small.faces) == np.arange(len(small.vertices))).all()
    away = np.linalg.norm(corners.reshape(-1, 3) - small.vertices[small.vertex_of], axis=1)
    assert np.quantile(away, 0.99) < 0.25


def test_the_same_mesh_gives_the_same_proxy() -> None:
    vertices, faces = sphere(12_000)
    one, other = (decimate(vertices, faces, 500) for _ in range(2))
    assert (one.vertices == other.vertices).all()
    assert (one.faces == other.faces).all()
