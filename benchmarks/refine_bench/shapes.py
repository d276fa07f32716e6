"""Objects with randomised proportions, made here, as ground truth: watertight, Y up, facing +X.

Every generator takes a numpy Generator and draws its proportions from it, so a seed names an object. All but
the ones in `ASYMMETRIC` are symmetric about the plane z = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.random import Generator

from .furniture import arm_lamp, bench, cabinet, corner_sofa, display, open_cabinet, sofa, speaker
from .solids import box, disc_across_x, extruded, foil, loft, mirrored, revolved, rod, rounded_box, union


def airplane(rng: Generator) -> Manifold:
    """An airliner: thin and flat."""
    span, sweep, radius = rng.uniform(0.46, 0.54), rng.uniform(0.14, 0.22), rng.uniform(0.048, 0.058)
    tail_height, engine_z = rng.uniform(0.17, 0.21), rng.uniform(0.15, 0.19)
    profile = [
        (0.50, 0.1, -0.30), (0.485, 0.42, -0.22), (0.455, 0.68, -0.12), (0.41, 0.88, -0.04), (0.34, 1.0, 0.0),
        (-0.20, 1.0, 0.0), (-0.33, 0.8, 0.18), (-0.43, 0.45, 0.42), (-0.50, 0.14, 0.62),
    ]  # fmt: skip
    fuselage = loft([disc_across_x(x, y * radius, 0.0, r * radius) for x, r, y in profile])
    root, kink = foil(0.13, 0.27, 0.14, -0.4 * radius, 0.0), foil(0.03, 0.16, 0.14, -0.012, 0.4 * span)
    wing = loft([root, kink, foil(0.11 - sweep - 0.04, 0.075, 0.15, 0.025, span)])
    stabiliser = loft([foil(-0.37, 0.13, 0.12, 0.025, 0.0), foil(-0.45, 0.06, 0.15, 0.035, 0.19)])
    upright = loft([foil(-0.33, 0.17, 0.10, 0.0, 0.02), foil(-0.45, 0.075, 0.14, 0.0, tail_height + 0.04)])
    fin = upright.rotate((-90.0, 0.0, 0.0))  # its span, along +z, becomes +y
    centre_y = -0.066
    cowl = [(0.145, 0.026), (0.13, 0.032), (0.06, 0.032), (0.0, 0.019)]
    nacelle = loft([disc_across_x(x, centre_y, engine_z, r) for x, r in cowl])
    intake = rod((0.11, centre_y, engine_z), (0.2, centre_y, engine_z), 0.022)
    pylon = box((0.08, 0.05, 0.01), (0.05, centre_y + 0.035, engine_z))
    return union([fuselage, fin, mirrored(wing), mirrored(stabiliser), mirrored(nacelle - intake + pylon)])


def _chair(rng: Generator, armrests: int) -> Manifold:
    width, depth, seat_y = rng.uniform(0.44, 0.52), rng.uniform(0.42, 0.48), rng.uniform(0.42, 0.47)
    back_y, lean, leg = rng.uniform(0.92, 1.05), rng.uniform(0.05, 0.10), rng.uniform(0.02, 0.027)
    x, z = depth / 2 - 0.03, width / 2 - 0.03
    seat = rounded_box((depth, 0.05, width), (0.0, seat_y, 0.0), 0.02)
    legs = mirrored(
        rod((x + 0.02, 0.0, z + 0.015), (x, seat_y, z), 0.7 * leg, leg)
        + rod((-x - 0.04, 0.0, z + 0.015), (-x, seat_y, z), 0.7 * leg, leg)
    )
    top_x = -x - lean

    def at(height: float) -> float:  # x of the leaning back at a height
        return -x - lean * (height - seat_y) / (back_y - seat_y)

    posts = mirrored(rod((-x, seat_y, z), (top_x, back_y, z), leg, 0.8 * leg))
    rail = rounded_box((0.035, 0.10, width - 0.02), (at(back_y - 0.03), back_y - 0.03, 0.0), 0.015)
    slats = [
        rod((-x, seat_y, s * z), (at(back_y - 0.04), back_y - 0.04, s * z), 0.016) for s in (-0.5, 0.0, 0.5)
    ]
    stretcher_y = 0.35 * seat_y
    stretchers = mirrored(rod((x + 0.013, stretcher_y, z + 0.01), (-x - 0.026, stretcher_y, z + 0.01), 0.014))
    arm_y = seat_y + 0.21
    arm = rounded_box((x - at(arm_y) + 0.04, 0.035, 0.055), ((x + at(arm_y)) / 2, arm_y, z + 0.01), 0.015)
    arm += rod((x - 0.03, seat_y, z), (x - 0.03, arm_y, z + 0.01), 0.018)
    arms = [arm, arm.mirror((0.0, 0.0, 1.0))][:armrests]
    return union([seat, legs, posts, rail, *slats, stretchers, *arms])


def chair(rng: Generator) -> Manifold:
    """A wooden chair with a slatted back: legged."""
    return _chair(rng, armrests=0)


def one_armed_chair(rng: Generator) -> Manifold:
    """The chair with one armrest, at +z: asymmetric."""
    return _chair(rng, armrests=1)


def table(rng: Generator) -> Manifold:
    """A dining table: a thin plate on four legs."""
    length, width, height = rng.uniform(0.55, 0.7), rng.uniform(0.9, 1.1), rng.uniform(0.5, 0.62)
    leg, inset = rng.uniform(0.026, 0.034), 0.06
    x, z = length / 2 - inset, width / 2 - inset
    plate = rounded_box((length, 0.045, width), (0.0, height, 0.0), 0.02)
    legs = mirrored(
        rod((x + 0.02, 0.0, z + 0.02), (x, height, z), 0.65 * leg, leg)
        + rod((-x - 0.02, 0.0, z + 0.02), (-x, height, z), 0.65 * leg, leg)
    )
    apron = box((2 * x, 0.08, 2 * z), (0.0, height - 0.05, 0.0)) - box(
        (2 * x - 0.04, 0.3, 2 * z - 0.04), (0.0, height - 0.17, 0.0)
    )
    return union([plate, legs, apron])


def desk(rng: Generator) -> Manifold:
    """A desk with drawers at +z and two legs at -z: asymmetric."""
    length, width, height = rng.uniform(0.46, 0.54), rng.uniform(0.95, 1.05), rng.uniform(0.52, 0.6)
    drawers = rng.uniform(0.26, 0.34)
    x, z = length / 2 - 0.04, width / 2 - 0.05
    plate = rounded_box((length, 0.04, width), (0.0, height, 0.0), 0.015)
    body = box((length - 0.05, height - 0.06, drawers), (0.0, height / 2 + 0.03, z - drawers / 2 + 0.02))
    gaps = [
        box(
            (0.03, 0.012, drawers),
            (length / 2 - 0.03, 0.06 + (height - 0.06) * k / 3, z - drawers / 2 + 0.02),
        )
        for k in (1, 2)
    ]
    legs = union([rod((s * x, 0.0, -z - 0.01), (s * x, height, -z), 0.017, 0.022) for s in (-1, 1)])
    back = box((0.02, 0.5 * height, 2 * z), (-x, 0.72 * height, 0.0))
    return union([plate, body - union(gaps), legs, back])


def car(rng: Generator) -> Manifold:
    """A saloon car: compact."""
    width, roof_y, wheel = rng.uniform(0.38, 0.42), rng.uniform(0.29, 0.33), rng.uniform(0.068, 0.076)
    cabin_x, belt_y = rng.uniform(-0.06, -0.01), 0.195
    outline = [
        (-0.49, 0.07), (0.49, 0.07), (0.50, 0.10), (0.49, 0.145), (0.43, 0.175),
        (0.20, belt_y), (-0.38, belt_y + 0.01), (-0.48, 0.195), (-0.50, 0.14),
    ]  # fmt: skip
    flanks = extruded(outline, width)
    waist = [(x * 0.985, y if y < 0.15 else 0.985 * y) for x, y in outline]
    body = (flanks ^ extruded(waist, 0.94 * width)) + extruded(
        [(0.97 * x, min(y, 0.155)) for x, y in outline], width
    )
    low, high = 0.45 * width, 0.36 * width
    glass = np.array(
        [(0.24, belt_y - 0.01, low), (-0.30, belt_y - 0.01, low), (0.07, roof_y, high), (-0.19, roof_y, high)]
    )
    glass[:, 0] += cabin_x
    cabin = Manifold.hull_points(np.concatenate([glass, glass * [1, 1, -1]]))
    arches, wheels = [], []
    for x in (0.31, -0.31):
        z = width / 2
        arches.append(rod((x, wheel, z - 0.09), (x, wheel, z + 0.05), wheel + 0.016))
        wheels.append(rod((x, wheel, z - 0.07), (x, wheel, z - 0.004), wheel))
    mirrors = rounded_box((0.03, 0.03, 0.05), (0.15 + cabin_x, belt_y + 0.03, width / 2), 0.012)
    return union([body - mirrored(union(arches)), cabin, mirrored(union(wheels)), mirrored(mirrors)])


def mug(rng: Generator) -> Manifold:
    """A mug with its handle at +x: hollow, with a hole through the handle."""
    radius, height, wall = rng.uniform(0.3, 0.36), rng.uniform(0.74, 0.86), rng.uniform(0.035, 0.045)
    foot = 0.93 * radius
    outer = [(0.0, 0.0), (foot, 0.0), (radius, 0.06), (radius, height), (0.0, height)]
    inner = [
        (0.0, 0.06),
        (foot - wall, 0.06),
        (radius - wall, 0.12),
        (radius - wall, height + 1),
        (0.0, height + 1),
    ]
    reach, half = rng.uniform(0.22, 0.27), rng.uniform(0.25, 0.29)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    x, y = radius - 0.6 * wall + reach * np.cos(angle), height / 2 + half * np.sin(angle)
    joints = [
        Manifold.sphere(0.045, 16).scale((0.8, 0.8, 1.1)).translate((a, b, 0.0))
        for a, b in zip(x, y, strict=True)
    ]
    handle = union([Manifold.batch_hull([a, b]) for a, b in pairwise(joints)])
    return (revolved(outer) + handle) - revolved(inner)


def lamp(rng: Generator) -> Manifold:
    """A table lamp: a thin stem between a foot and a hollow shade."""
    height, foot, stem = rng.uniform(0.95, 1.05), rng.uniform(0.17, 0.21), rng.uniform(0.018, 0.024)
    low, high, shade = rng.uniform(0.27, 0.32), rng.uniform(0.15, 0.19), rng.uniform(0.34, 0.4)
    base = [(0.0, 0.0), (foot, 0.0), (foot, 0.03), (0.4 * foot, 0.055), (stem, 0.12)]
    bulge = [(stem, 0.2), (0.085, 0.3), (0.07, 0.38), (stem, 0.46)]
    body = [*base, *bulge, (stem, height - 0.06), (0.0, height - 0.06)]
    bottom, top, wall = height - shade, height, 0.02
    cone = [
        (low - wall, bottom),
        (low, bottom),
        (high, top),
        (0.0, top),
        (0.0, top - wall),
        (high - wall, top - wall),
    ]
    return revolved(body) + revolved(cone)


GENERATORS: Mapping[str, Callable[[Generator], Manifold]] = {
    generator.__name__: generator
    for generator in (
        airplane, arm_lamp, bench, cabinet, car, chair, corner_sofa, desk, display, lamp, mug,
        one_armed_chair, open_cabinet, sofa, speaker, table,
    )
}  # fmt: skip
ASYMMETRIC = frozenset({"arm_lamp", "corner_sofa", "desk", "one_armed_chair", "open_cabinet"})


def make_shape(category: str, seed: int) -> trimesh.Trimesh:
    """The object that `seed` names: watertight, longest side 1, its box centred in x and y.

    z is left alone, so that the plane of symmetry of every symmetric category is z = 0.
    """
    if category not in GENERATORS:
        raise ValueError(f"expected a category among {', '.join(GENERATORS)}, got {category!r}")
    return normalised(GENERATORS[category](np.random.default_rng(seed)))


def normalised(solid: Manifold) -> trimesh.Trimesh:
    """The surface of a solid: longest side 1, its box centred in x and y, z left alone."""
    mesh = solid.to_mesh()
    vertices = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3]
    low, high = vertices.min(0), vertices.max(0)
    centre = (low + high) / 2 * [1.0, 1.0, 0.0]
    return trimesh.Trimesh((vertices - centre) / (high - low).max(), mesh.tri_verts, process=False)
