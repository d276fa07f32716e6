"""Numba kernels of the CPU back end: one view at a time, without the interpreter's lock (nogil).

Each kernel walks the faces, and for a face the rows of its screen box grown by the cut-off radius. A row is
cut into runs of LANES pixels; the body has no branch, so that LLVM turns a run into vector instructions.
In it the distances along a side and to the left of it are linear in the pixel: one multiply-add each.
Images are padded by LANES columns on the right: a run may reach past the image, its surplus is dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .jit import numba_jit
from .oracle import CUTOFF, FLAT, LEAST_CONFIDENCE, NEAR

f32 = np.float32
Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
LANES = 16
ZERO, HALF, ONE, TWO, HUGE = f32(0), f32(0.5), f32(1), f32(2), f32(3e38)
CUT = f32(CUTOFF)
NEAREST_DEPTH = f32(NEAR)
LOG2_E = f32(math.log2(math.e))
TINY = f32(1e-12)
SHORTEST = 1e-6  # length of a side that has a direction, pixels
LEAST_SIGMA = f32(LEAST_CONFIDENCE)
FLAT_AREA = f32(FLAT)
# exp2 on (-1, 0]: Taylor coefficients ln(2)^k / k!
E1, E2, E3, E4, E5, E6 = (f32(math.log(2) ** k / math.factorial(k)) for k in range(1, 7))
# log(1 + t) / t on [0, 1]: interpolated at Chebyshev points, error of the logarithm below 2e-7
L_COEFFICIENTS = (
    *(0.99999981, -0.499974494, 0.332761766, -0.244996117),
    *(0.17757024, -0.107853679, 0.0442141923, -0.0085746762),
)
L0, L1, L2, L3, L4, L5, L6, L7 = (f32(c) for c in L_COEFFICIENTS)

FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
jit = numba_jit(fastmath=FAST, error_model="numpy")


@jit
def exp_negative(a: f32) -> f32:
    """exp(-a) for a >= 0, and never less than 2^-64: products with it are slow where they are denormal."""
    y = max(-a * LOG2_E, f32(-64))
    n = np.int32(y)  # towards zero: f in (-1, 0]
    f = y - f32(n)
    power = ONE + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * (E5 + f * E6)))))
    return power * np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)


@jit
def log1p_unit(t: f32) -> f32:
    """log(1 + t) for t in [0, 1]."""
    return t * (L0 + t * (L1 + t * (L2 + t * (L3 + t * (L4 + t * (L5 + t * (L6 + t * L7)))))))


@jit
def reach(extent: int, radius: f32, a: f32, b: f32, c: f32) -> tuple[int, int]:
    """First and last pixel of an axis of `extent` pixels that three corners reach within `radius`."""
    first, last = math.floor(min(a, b, c) - radius), math.floor(max(a, b, c) + radius)
    return max(0, first), min(extent - 1, last)


@jit
def orientation(ax: f32, ay: f32, bx: f32, by: f32, cx: f32, cy: f32, radius: f32) -> f32:
    """`oracle.orientation` of one face within `radius` pixels."""
    ux, uy, vx, vy, wx, wy = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy
    longest2 = max(ux * ux + uy * uy, vx * vx + vy * vy, wx * wx + wy * wy)
    area = ux * vy - uy * vx
    if abs(area) <= FLAT_AREA * (longest2 + math.sqrt(longest2) * radius):
        return ZERO
    return ONE if area > ZERO else -ONE


@jit
def side(ax: f32, ay: f32, bx: f32, by: f32, px: f32, py: f32, unit: f32) -> tuple[f32, f32, f32, f32, f32]:
    """The side from a to b as seen from the point p: (step x, step y, length, along, left).

    `along` is how far p lies along the side and `left` how far beside it; all in softness lengths, `unit` of
    which are a pixel. A pixel further in x, they are `step x` and `-step y` more, and a pixel further in y
    `step y` and `step x`. A side without length has the direction +x.
    """
    # in double precision: the corners of a face close to the camera are thousands of pixels away
    ux, uy = np.float64(bx) - np.float64(ax), np.float64(by) - np.float64(ay)
    dx, dy = np.float64(px) - np.float64(ax), np.float64(py) - np.float64(ay)
    length = math.sqrt(ux * ux + uy * uy)
    if length <= SHORTEST:
        return unit, ZERO, ZERO, f32(dx * unit), f32(dy * unit)
    scale = unit / length
    sx, sy = ux * scale, uy * scale
    return f32(sx), f32(sy), f32(length * unit), f32(dx * sx + dy * sy), f32(dy * sx - dx * sy)


@jit
def optical_depth(screen: Floats, faces: Ints, softness_px: f32, radius: f32, image: Floats) -> None:
    """Adds softplus(x_f(p)) of every face to `image` (H, W + LANES). screen (V, 3), faces (F, 3)."""
    height, width = image.shape[0], image.shape[1] - LANES
    unit = ONE / math.sqrt(softness_px)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(screen[a, 2], screen[b, 2], screen[c, 2]) <= NEAREST_DEPTH:
            continue
        ax, ay, bx, by = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1]
        cx, cy = screen[c, 0], screen[c, 1]
        x0, x1 = reach(width, radius, ax, bx, cx)
        y0, y1 = reach(height, radius, ay, by, cy)
        px, py = f32(x0) + HALF, f32(y0) + HALF
        ux, uy, u, u0, nu0 = side(ax, ay, bx, by, px, py, unit)
        vx, vy, v, v0, nv0 = side(bx, by, cx, cy, px, py, unit)
        wx, wy, w, w0, nw0 = side(cx, cy, ax, ay, px, py, unit)
        turn = orientation(ax, ay, bx, by, cx, cy, radius)
        for y in range(y0, y1 + 1):
            j = f32(y - y0)
            tu, tv, tw = u0 + j * uy, v0 + j * vy, w0 + j * wy
            nu, nv, nw = nu0 + j * ux, nv0 + j * vx, nw0 + j * wx
            row = image[y]
            for start in range(x0, x1 + 1, LANES):
                run = row[start : start + LANES]
                i = f32(start - x0)
                for k in range(LANES):
                    x = i + f32(k)
                    along, left_u = tu + x * ux, nu - x * uy
                    beyond = along - min(max(along, ZERO), u)
                    d2 = left_u * left_u + beyond * beyond
                    along, left_v = tv + x * vx, nv - x * vy
                    beyond = along - min(max(along, ZERO), v)
                    d2 = min(d2, left_v * left_v + beyond * beyond)
                    along, left_w = tw + x * wx, nw - x * wy
                    beyond = along - min(max(along, ZERO), w)
                    d2 = min(d2, left_w * left_w + beyond * beyond)
                    inside = min(turn * left_u, turn * left_v, turn * left_w) > ZERO
                    value = log1p_unit(exp_negative(d2)) + (d2 if inside else ZERO)
                    run[k] += value if (inside | (d2 < CUT)) else ZERO


@jit
def next_nonzero(grad: Floats, padded: Floats, following: Ints) -> None:
    """Prepares a gradient (H, W) for `optical_depth_backward`.

    `padded` (H, W + LANES) is a copy with zeros appended; following[y, x] (H, W + 1) is the first column >= x
    with a gradient worth following, or W.
    """
    height, width = grad.shape
    largest = ZERO
    for y in range(height):
        for x in range(width):
            value = grad[y, x]
            padded[y, x] = value
            largest = max(largest, abs(value))
        padded[y, width:] = ZERO
    least = largest * f32(1e-7)
    for y in range(height):
        upcoming = width
        following[y, width] = width
        for x in range(width - 1, -1, -1):
            if abs(grad[y, x]) > least:
                upcoming = x
            following[y, x] = upcoming


@jit
def optical_depth_backward(
    screen: Floats, faces: Ints, softness_px: f32, radius: f32, grad: Floats, following: Ints, out: Floats
) -> None:
    """Adds dL/d(x, y) of every vertex to `out` (V, 2), from grad = dL/dS (H, W + LANES)."""
    height, width = grad.shape[0], grad.shape[1] - LANES
    unit = ONE / math.sqrt(softness_px)
    sums = np.empty((6, LANES), np.float32)  # by lane: a reduction within the runs would cost more than they
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(screen[a, 2], screen[b, 2], screen[c, 2]) <= NEAREST_DEPTH:
            continue
        ax, ay, bx, by = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1]
        cx, cy = screen[c, 0], screen[c, 1]
        x0, x1 = reach(width, radius, ax, bx, cx)
        y0, y1 = reach(height, radius, ay, by, cy)
        px, py = f32(x0) + HALF, f32(y0) + HALF
        ux, uy, u, u0, nu0 = side(ax, ay, bx, by, px, py, unit)
        vx, vy, v, v0, nv0 = side(bx, by, cx, cy, px, py, unit)
        wx, wy, w, w0, nw0 = side(cx, cy, ax, ay, px, py, unit)
        turn = orientation(ax, ay, bx, by, cx, cy, radius)
        iu, iv, iw = ONE / max(u, TINY), ONE / max(v, TINY), ONE / max(w, TINY)
        sums[:] = ZERO
        for y in range(y0, y1 + 1):
            j = f32(y - y0)
            tu, tv, tw = u0 + j * uy, v0 + j * vy, w0 + j * wy
            nu, nv, nw = nu0 + j * ux, nv0 + j * vx, nw0 + j * wx
            row = grad[y]
            start = following[y, x0] if x0 <= x1 else width
            while start <= x1:
                run = row[start : start + LANES]
                i = f32(start - x0)
                for k in range(LANES):
                    x = i + f32(k)
                    # nearest point of the outline: its side (dx, dy), the share t of the side before it, and
                    # the offset from it, `beyond` in the side's direction and `left` across
                    along, left_u = tu + x * ux, nu - x * uy
                    on_u = min(max(along, ZERO), u)
                    beyond_u = along - on_u
                    d2_u = left_u * left_u + beyond_u * beyond_u
                    along, left_v = tv + x * vx, nv - x * vy
                    on_v = min(max(along, ZERO), v)
                    beyond_v = along - on_v
                    d2_v = left_v * left_v + beyond_v * beyond_v
                    along, left_w = tw + x * wx, nw - x * wy
                    on_w = min(max(along, ZERO), w)
                    beyond_w = along - on_w
                    d2_w = left_w * left_w + beyond_w * beyond_w
                    d2 = min(d2_u, d2_v, d2_w)
                    is_v, is_w = d2_v == d2, d2_w == d2
                    left = left_w if is_w else (left_v if is_v else left_u)
                    beyond = beyond_w if is_w else (beyond_v if is_v else beyond_u)
                    t = on_w * iw if is_w else (on_v * iv if is_v else on_u * iu)
                    dx = wx if is_w else (vx if is_v else ux)
                    dy = wy if is_w else (vy if is_v else uy)
                    inside = min(turn * left_u, turn * left_v, turn * left_w) > ZERO
                    # dS/dx = sigmoid(x); dx/dcorner = -+ 2 q z / s, z the weight of the corner
                    e = exp_negative(d2)
                    weight = (ONE if inside else -e) / (ONE + e) * run[k]
                    weight = weight if (inside | (d2 < CUT)) else ZERO
                    qx, qy = weight * (beyond * dx - left * dy), weight * (beyond * dy + left * dx)
                    za = t if is_w else (ZERO if is_v else ONE - t)
                    zb = ZERO if is_w else (ONE - t if is_v else t)
                    zc = ONE - t if is_w else (t if is_v else ZERO)
                    sums[0, k] += qx * za
                    sums[1, k] += qy * za
                    sums[2, k] += qx * zb
                    sums[3, k] += qy * zb
                    sums[4, k] += qx * zc
                    sums[5, k] += qy * zc
                start += LANES
                start = following[y, start] if start < width else width
        out[a, 0] -= TWO * sums[0].sum()
        out[a, 1] -= TWO * sums[1].sum()
        out[b, 0] -= TWO * sums[2].sum()
        out[b, 1] -= TWO * sums[3].sum()
        out[c, 0] -= TWO * sums[4].sum()
        out[c, 1] -= TWO * sums[5].sum()


@jit
def rasterize(
    screen: Floats,
    faces: Ints,
    orthographic: bool,
    depth: Floats,
    face_image: NDArray[np.int64],
    weight_image: Floats,
) -> None:
    """Z-buffer of one view: writes depth (H, W), face index, and weights of its corners (H, W, 3)."""
    height, width = face_image.shape
    depth[:] = HUGE
    face_image[:] = -1
    weight_image[:] = ZERO
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        az, bz, cz = screen[a, 2], screen[b, 2], screen[c, 2]
        if min(az, bz, cz) <= NEAREST_DEPTH:
            continue
        ax, ay, bx, by = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1]
        cx, cy = screen[c, 0], screen[c, 1]
        turn = orientation(ax, ay, bx, by, cx, cy, ZERO)
        if turn == ZERO:
            continue
        x0, x1 = reach(width, ZERO, ax, bx, cx)
        y0, y1 = reach(height, ZERO, ay, by, cy)
        ia, ib, ic = (turn, turn, turn) if orthographic else (turn / az, turn / bz, turn / cz)
        for y in range(y0, y1 + 1):
            py = f32(y) + HALF
            for x in range(x0, x1 + 1):
                px = f32(x) + HALF
                wa = ia * ((cx - bx) * (py - by) - (cy - by) * (px - bx))
                wb = ib * ((ax - cx) * (py - cy) - (ay - cy) * (px - cx))
                wc = ic * ((bx - ax) * (py - ay) - (by - ay) * (px - ax))
                if min(wa, wb, wc) < ZERO:
                    continue
                scale = ONE / (wa + wb + wc)
                wa, wb, wc = wa * scale, wb * scale, wc * scale
                z = wa * az + wb * bz + wc * cz
                if z < depth[y, x]:
                    depth[y, x] = z
                    face_image[y, x] = f
                    weight_image[y, x, 0] = wa
                    weight_image[y, x, 1] = wb
                    weight_image[y, x, 2] = wc


@jit
def image_symmetry(
    seen: Floats,
    mirrored: Floats,
    face_image: NDArray[np.int64],
    weight_image: Floats,
    faces: Ints,
    confidence: Floats,
    cost: f32,
    d_seen: Floats,
    d_mirrored: Floats,
    d_confidence: Floats,
) -> float:
    """Sum over the covered pixels of one view pair of sigma (flip(alpha) - alpha')^2 + cost ln(1 / sigma).

    Writes its derivatives with respect to both optical depths (H, W) and adds those of the confidence (V,).
    """
    height, width = seen.shape
    d_seen[:] = ZERO
    d_mirrored[:] = ZERO
    total = 0.0
    for y in range(height):
        for x in range(width):
            f = face_image[y, x]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            wa, wb, wc = weight_image[y, x, 0], weight_image[y, x, 1], weight_image[y, x, 2]
            sigma = wa * confidence[a] + wb * confidence[b] + wc * confidence[c]
            bounded = max(sigma, LEAST_SIGMA)
            clear = exp_negative(seen[y, width - 1 - x])
            clear_mirrored = exp_negative(mirrored[y, x])
            difference = clear_mirrored - clear  # flip(alpha) - alpha'
            total += sigma * difference * difference - cost * math.log(bounded)
            d_seen[y, width - 1 - x] = TWO * sigma * difference * clear
            d_mirrored[y, x] = -TWO * sigma * difference * clear_mirrored
            d_sigma = difference * difference - (cost / sigma if sigma >= LEAST_SIGMA else ZERO)
            d_confidence[a] += wa * d_sigma
            d_confidence[b] += wb * d_sigma
            d_confidence[c] += wc * d_sigma
    return total
