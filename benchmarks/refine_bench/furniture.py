"""More of the paper's categories, and asymmetric relatives of some, in the manner of `shapes`."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold
from numpy.random import Generator

from .solids import box, disc_across_x, extruded, loft, mirrored, revolved, rod, rounded_box, union


def bench(rng: Generator) -> Manifold:
    """A park bench: two plank seats, a low slatted back, a leg frame at either end."""
    width, depth, seat_y = rng.uniform(0.95, 1.15), rng.uniform(0.36, 0.44), rng.uniform(0.36, 0.42)
    back_y, lean = seat_y + rng.uniform(0.3, 0.4), rng.uniform(0.06, 0.11)
    z = width / 2 - 0.12
    planks = [
        rounded_box((0.42 * depth, 0.035, width), (s * 0.26 * depth, seat_y, 0.0), 0.012) for s in (-1, 1)
    ]
    share = (0.45, 0.9)
    slats = [
        rounded_box((0.03, 0.1, width), (-depth / 2 - s * lean, seat_y + s * (back_y - seat_y), 0.0), 0.012)
        for s in share
    ]
    bearer = box((depth, 0.05, 0.05), (0.0, seat_y - 0.03, z))
    post = rod((-depth / 2 + 0.01, seat_y - 0.03, z), (-depth / 2 - lean, back_y, z), 0.026)
    legs = rod((depth / 2 - 0.03, 0.0, z), (depth / 2 - 0.05, seat_y, z), 0.026) + rod(
        (-depth / 2 - 0.03, 0.0, z), (-depth / 2 + 0.02, seat_y, z), 0.026
    )
    return union([*planks, *slats, mirrored(bearer + post + legs)])


def _cabinet_body(rng: Generator) -> tuple[Manifold, float, float, float, float]:
    """Carcass with a recessed plinth and a top board; its depth, height, width and plinth height."""
    depth, height, width = rng.uniform(0.34, 0.45), rng.uniform(0.6, 0.95), rng.uniform(0.6, 0.8)
    plinth = rng.uniform(0.05, 0.09)
    body = box((depth, height - plinth, width), (0.0, plinth + (height - plinth) / 2, 0.0))
    foot = box((depth - 0.08, plinth + 0.02, width - 0.06), (-0.02, plinth / 2, 0.0))
    top = rounded_box((depth + 0.05, 0.035, width + 0.06), (0.01, height, 0.0), 0.012)
    return union([body, foot, top]), depth, height, width, plinth


def cabinet(rng: Generator) -> Manifold:
    """A sideboard with two doors and round handles."""
    body, depth, height, width, plinth = _cabinet_body(rng)
    middle = (plinth + height) / 2
    gap = box((0.03, height - plinth - 0.08, 0.014), (depth / 2, middle, 0.0))
    knob = rod((depth / 2 - 0.01, middle, 0.06), (depth / 2 + 0.04, middle, 0.06), 0.018)
    rim = box((0.024, 0.014, width), (depth / 2, height - 0.14, 0.0))
    return (body - gap - rim) + mirrored(knob)


def open_cabinet(rng: Generator) -> Manifold:
    """The sideboard with an open shelf at +z and a closed door at -z: asymmetric."""
    body, depth, height, width, plinth = _cabinet_body(rng)
    clear, share = height - plinth - 0.07, rng.uniform(0.4, 0.5)
    bay = share * width
    shelf_y = plinth + 0.02 + 0.5 * clear
    hollow = box((depth, clear, bay), (0.05, plinth + 0.03 + clear / 2, width / 2 - 0.03 - bay / 2))
    shelf = box((depth - 0.08, 0.03, bay + 0.02), (0.0, shelf_y, width / 2 - 0.03 - bay / 2))
    handle = rod((depth / 2 + 0.02, shelf_y - 0.07, -0.02), (depth / 2 + 0.02, shelf_y + 0.07, -0.02), 0.016)
    stand = box((0.06, 0.03, 0.03), (depth / 2, shelf_y, -0.02))
    return (body - hollow) + shelf + handle + stand


def display(rng: Generator) -> Manifold:
    """A monitor: a thin panel with a bulge at its back, on a stem and a foot."""
    width, ratio, stem = rng.uniform(0.9, 1.05), rng.uniform(0.55, 0.64), rng.uniform(0.14, 0.2)
    height, foot = width * ratio, rng.uniform(0.24, 0.32)
    middle = stem + height / 2
    panel = rounded_box((0.05, height, width), (0.0, middle, 0.0), 0.016)
    screen = box((0.02, height - 0.05, width - 0.05), (0.026, middle, 0.0))
    bulge = loft(
        [
            disc_across_x(-0.02, middle, 0.0, 0.32 * height),
            disc_across_x(-0.075, middle - 0.02, 0.0, 0.2 * height),
        ]
    )
    neck = box((0.035, stem + 0.3 * height, 0.09), (-0.045, (stem + 0.3 * height) / 2, 0.0))
    base = rounded_box((0.22, 0.024, foot), (-0.03, 0.012, 0.0), 0.01)
    return union([panel - screen, bulge, neck, base])


def speaker(rng: Generator) -> Manifold:
    """A floor speaker: a box tapered to the back, two cones set into its front, four short feet."""
    width, depth, height = rng.uniform(0.3, 0.38), rng.uniform(0.32, 0.42), rng.uniform(0.85, 1.0)
    taper = rng.uniform(0.75, 0.95)
    corners = [
        (x, y, s * z)
        for x, z in ((depth / 2, width / 2), (-depth / 2, taper * width / 2))
        for y in (0.04, height)
        for s in (-1, 1)
    ]
    body = Manifold.hull_points(np.array(corners))
    woofer, tweeter = 0.38 * width, 0.2 * width
    cones = [
        rod((depth / 2 - 0.07, y, 0.0), (depth / 2 + 0.02, y, 0.0), 0.5 * r, r)
        for y, r in ((0.35 * height, woofer), (0.78 * height, tweeter))
    ]
    caps = [
        Manifold.sphere(0.35 * r, 20).translate((depth / 2 - 0.05, y, 0.0))
        for y, r in ((0.35 * height, woofer), (0.78 * height, tweeter))
    ]
    z = 0.35 * width
    feet = mirrored(
        union([rod((s * 0.36 * depth, 0.0, z * t), (s * 0.36 * depth, 0.06, z * t), 0.022, 0.03)
               for s, t in ((1, 1.0), (-1, taper))])
    )  # fmt: skip
    return union([body - union(cones), *caps, feet])


def _sofa(rng: Generator) -> tuple[Manifold, float, float, float]:
    """Frame, seat cushions, back and both arms; its depth, seat height and width."""
    width, depth, seat_y = rng.uniform(0.95, 1.15), rng.uniform(0.42, 0.5), rng.uniform(0.22, 0.27)
    back_y, arm_y, arm = rng.uniform(0.46, 0.56), seat_y + rng.uniform(0.1, 0.16), rng.uniform(0.09, 0.13)
    frame = rounded_box((depth, seat_y - 0.1, width - arm), (0.0, 0.06 + (seat_y - 0.1) / 2, 0.0), 0.02)
    inside = (width - 2 * arm) / 2
    cushion = rounded_box((depth - 0.1, 0.1, inside), (0.05, seat_y - 0.02, inside / 2), 0.03)
    back_profile = [
        (-depth / 2 - 0.08, back_y), (-depth / 2 - 0.02, 0.06), (-depth / 2 + 0.14, 0.06),
        (-depth / 2 + 0.05, back_y),
    ]  # fmt: skip
    back = extruded(back_profile, width - 0.04)
    side = rounded_box(
        (depth + 0.02, arm_y - 0.05, arm), (0.0, 0.05 + (arm_y - 0.05) / 2, width / 2 - arm / 2), 0.03
    )
    x, z = depth / 2 - 0.06, width / 2 - 0.06
    legs = union([rod((s * x, 0.0, z), (s * x, 0.08, z), 0.02, 0.028) for s in (-1, 1)])
    return union([frame, back, mirrored(union([cushion, side, legs]))]), depth, seat_y, width


def sofa(rng: Generator) -> Manifold:
    """A two-seat sofa."""
    return _sofa(rng)[0]


def corner_sofa(rng: Generator) -> Manifold:
    """The sofa with a chaise longue towards +x at its +z end: asymmetric."""
    body, depth, seat_y, width = _sofa(rng)
    reach, seat = rng.uniform(0.3, 0.4), 0.42 * width
    z = width / 2 - seat / 2
    chaise = rounded_box(
        (reach + 0.1, seat_y - 0.06, seat), (depth / 2 + reach / 2, 0.07 + (seat_y - 0.06) / 2, z), 0.03
    )
    x = depth / 2 + reach - 0.03
    legs = [
        rod((x, 0.0, z + s * (seat / 2 - 0.06)), (x, 0.09, z + s * (seat / 2 - 0.06)), 0.02, 0.028)
        for s in (-1, 1)
    ]
    return union([body, chaise, *legs])


def arm_lamp(rng: Generator) -> Manifold:
    """A desk lamp whose jointed arm leans towards +z: asymmetric."""
    foot, elbow_y, elbow_z = rng.uniform(0.17, 0.21), rng.uniform(0.45, 0.55), rng.uniform(-0.24, -0.16)
    head_y, head_z, shade = rng.uniform(0.82, 0.95), rng.uniform(0.2, 0.3), rng.uniform(0.13, 0.17)
    base = revolved([(0.0, 0.0), (foot, 0.0), (foot, 0.03), (0.4 * foot, 0.05), (0.0, 0.05)])
    elbow, head = (0.0, elbow_y, elbow_z), (0.0, head_y, head_z)
    arm = rod((0.0, 0.03, 0.0), elbow, 0.022) + rod(elbow, head, 0.02)
    joints = [Manifold.sphere(0.035, 20).translate(place) for place in (elbow, head)]
    tip = (0.06, head_y - 0.2, head_z + 0.07)
    hollow = (0.066, head_y - 0.22, head_z + 0.077)
    bell = rod(head, tip, 0.045, shade) - rod(
        (0.018, head_y - 0.06, head_z + 0.021), hollow, 0.03, shade - 0.012
    )
    return union([base, arm, *joints, bell])
