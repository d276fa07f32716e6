"""Convex pieces, lofts and surfaces of revolution as watertight solids (manifold3d).

World: right-handed, Y up, symmetry plane with normal +Z, objects face +X. Lengths are arbitrary: `shapes`
normalises the finished object.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from numpy.typing import NDArray

Array = NDArray[np.float64]
Point = tuple[float, float, float]
CIRCLE_SEGMENTS = 20  # fine enough that a silhouette at 224 pixels looks round


def union(pieces: Sequence[Manifold]) -> Manifold:
    return Manifold.batch_boolean(list(pieces), OpType.Add)


def mirrored(piece: Manifold) -> Manifold:
    """The piece together with its mirror image in the plane z = 0."""
    return piece + piece.mirror((0.0, 0.0, 1.0))


def box(size: Point, centre: Point) -> Manifold:
    return Manifold.cube(size, True).translate(centre)


def rounded_box(size: Point, centre: Point, radius: float) -> Manifold:
    """A box whose edges are rounded: the hull of eight balls in its corners."""
    inner = np.array(size) / 2 - radius
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    ball = Manifold.sphere(radius, 12)
    return Manifold.batch_hull([ball.translate(tuple(s * inner + centre)) for s in signs])


def rod(start: Point, end: Point, radius_start: float, radius_end: float | None = None) -> Manifold:
    """A cylinder, or a cone's frustum, between two points."""
    axis = np.array(end) - np.array(start)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 * np.linalg.norm(axis) else [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis / np.linalg.norm(axis), side)
    angle = np.arange(CIRCLE_SEGMENTS)[:, None] * (2 * np.pi / CIRCLE_SEGMENTS)
    ring = np.cos(angle) * side + np.sin(angle) * other
    radius_end = radius_start if radius_end is None else radius_end
    return Manifold.hull_points(np.concatenate([ring * radius_start + start, ring * radius_end + end]))


def loft(sections: Sequence[Array]) -> Manifold:
    """The union of the hulls of neighbouring convex sections, each (N, 3)."""
    return union([Manifold.hull_points(np.concatenate(pair)) for pair in pairwise(sections)])


def disc_across_x(x: float, y: float, z: float, radius: float) -> Array:
    """A circle in the plane of constant x, (N, 3)."""
    angle = np.arange(CIRCLE_SEGMENTS) * (2 * np.pi / CIRCLE_SEGMENTS)
    return np.stack([np.full_like(angle, x), y + radius * np.cos(angle), z + radius * np.sin(angle)], 1)


def foil(leading_x: float, chord: float, thickness: float, height: float, span: float) -> Array:
    """A symmetric wing section in the plane z = span, (N, 3): leading edge towards +x, chord along -x."""
    t = (1 - np.cos(np.linspace(0, np.pi, 9))) / 2
    half = 0.5 * thickness * chord * np.sqrt(t) * (1 - t) / 0.385  # thickest at a third of the chord
    x = np.concatenate([leading_x - chord * t, leading_x - chord * t])
    y = height + np.concatenate([half, -half])
    return np.stack([x, y, np.full_like(x, span)], 1)


def revolved(profile: Sequence[tuple[float, float]], segments: int = 40) -> Manifold:
    """The closed (radius, height) polygon turned about the Y axis."""
    return CrossSection([list(profile)]).revolve(segments).rotate((-90.0, 0.0, 0.0))


def extruded(outline: Sequence[tuple[float, float]], width: float) -> Manifold:
    """The closed (x, y) polygon, counter-clockwise, as thick as `width` along Z, centred at z = 0."""
    return CrossSection([list(outline)]).extrude(width).translate((0.0, 0.0, -width / 2))
