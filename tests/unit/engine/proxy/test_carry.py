"""What a carried displacement has to be: exact where it is affine, near where it is smooth, without steps."""

from __future__ import annotations

import numpy as np
import pytest
from surfaces import grid, sphere

from refine_engine.proxy.carry import Carrier
from refine_engine.proxy.collapse import Floats
from refine_engine.proxy.decimate import decimate

VERTICES, FACES = sphere(20_000)


@pytest.fixture(scope="module")
def carrier() -> Carrier:
    """From 800 vertices to 20,000."""
    return Carrier.of(decimate(VERTICES, FACES, 800), VERTICES)


def wave(points: Floats) -> Floats:
    """A displacement of up to 0.05 along the normal of a sphere, over a length of about 0.6."""
    return np.asarray(
        0.05 * np.sin(10 * points[:, :1]) * points / np.linalg.norm(points, axis=1, keepdims=True)
    )


def test_an_affine_displacement_arrives_as_it_is(carrier: Carrier) -> None:
    """A scale, a shear and a shift: most of what the fit of the proportions does."""
    matrix = np.array([[0.2, 0.1, 0.0], [0.0, -0.3, 0.0], [0.05, 0.0, 0.1]])

    def affine(points: Floats) -> Floats:
        return np.asarray(points @ matrix + [0.1, -0.2, 0.3])

    carried = carrier.displacement(affine(carrier.proxy.vertices))
    np.testing.assert_allclose(carried, affine(VERTICES), atol=1e-9)


def test_what_did_not_move_does_not_move(carrier: Carrier) -> None:
    assert not carrier.displacement(np.zeros((800, 3))).any()


def test_a_smooth_displacement_arrives(carrier: Carrier) -> None:
    carried = carrier.displacement(wave(carrier.proxy.vertices))
    assert np.abs(carried - wave(VERTICES)).max() < 0.1 * 0.05


def test_nothing_steps_from_vertex_to_vertex(carrier: Carrier) -> None:
    """Between neighbours of the fine mesh the carried wave changes no more than the wave itself."""
    edges = np.unique(np.sort(FACES[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    carried, true = carrier.displacement(wave(carrier.proxy.vertices)), wave(VERTICES)
    step, true_step = (np.linalg.norm(d[edges[:, 0]] - d[edges[:, 1]], axis=1) for d in (carried, true))
    assert step.max() < 1.1 * true_step.max()


def test_near_sheets_move_on_their_own() -> None:
    """A plate that grows thicker: what is near in space is not near on the surface."""
    one, faces = grid(110, 110)
    apart = np.array([0, 0, 0.01])
    plate = np.concatenate([one, one + apart])
    both = Carrier.of(decimate(plate, np.concatenate([faces, faces + len(one)]), 1000), plate)
    outwards = np.where(both.proxy.vertices[:, 2:] > 0.005, 0.02, -0.02) * np.array([0, 0, 1])
    outwards *= np.cos(3 * both.proxy.vertices[:, :1])  # no affine map
    carried = both.displacement(outwards)[:, 2]
    expected = np.where(plate[:, 2] > 0.005, 0.02, -0.02) * np.cos(3 * plate[:, 0])
    np.testing.assert_allclose(carried, expected, atol=0.002)


def test_values_stay_between_those_around_them(carrier: Carrier) -> None:
    left = (carrier.proxy.vertices[:, 0] < 0).astype(float)
    carried = carrier.values(left)
    assert 0 <= carried.min() < carried.max() <= 1
    assert (carried[VERTICES[:, 0] < -0.15] == 1).all()
    assert (carried[VERTICES[:, 0] > 0.15] == 0).all()


def test_faces_are_removed_where_those_of_the_proxy_are(carrier: Carrier) -> None:
    centres = carrier.proxy.vertices[carrier.proxy.faces].mean(1)
    kept = carrier.kept(centres[:, 0] < 0.3, FACES)
    x = VERTICES[FACES].mean(1)[:, 0]
    assert kept[x < 0.25].all()
    assert not kept[x > 0.35].any()
