"""Numba kernels of the CPU back end: one view at a time, no allocation, no lock (nogil).

Each kernel walks the faces, and for a face the rows of its screen box grown by the cut-off radius. A row is
cut into runs of LANES pixels; the body has no branch, so that LLVM turns a run into vector instructions.
Images are padded by LANES columns on the right: a run may reach past the image, its surplus is dropped.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .oracle import CUTOFF, NEAR

f32 = np.float32
Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
LANES = 16
ZERO, HALF, ONE, TWO, HUGE = f32(0), f32(0.5), f32(1), f32(2), f32(3e38)
CUT = f32(CUTOFF)
NEAREST_DEPTH = f32(NEAR)
LOG2_E = f32(math.log2(math.e))
LN2 = f32(math.log(2))
TINY = f32(1e-12)
LEAST_CONFIDENCE = f32(1e-6)  # as in losses.confidence_cost
FLAT = f32(1e-6)  # several roundings: area of a face, over its length times its reach, that counts as none
# exp2 on (-1, 0]: Taylor coefficients ln(2)^k / k!
E1, E2, E3, E4, E5, E6 = (f32(math.log(2) ** k / math.factorial(k)) for k in range(1, 7))
# log1p(t) = 2 atanh(z), z = t / (2 + t): 2 z (1 + z^2 / 3 + z^4 / 5 + ...)
L3, L5, L7, L9, L11 = (f32(1 / k) for k in (3, 5, 7, 9, 11))

FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}
jit = njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")


@jit
def exp_negative(a: f32) -> f32:
    """exp(-a) for a >= 0."""
    y = max(-a * LOG2_E, f32(-126))
    n = np.int32(y)  # towards zero: f in (-1, 0]
    f = y - f32(n)
    power = ONE + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * (E5 + f * E6)))))
    return power * np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)


@jit
def log1p_unit(t: f32) -> f32:
    """log(1 + t) for t in [0, 1]."""
    z = t / (TWO + t)
    w = z * z
    return TWO * z * (ONE + w * (L3 + w * (L5 + w * (L7 + w * (L9 + w * L11)))))


@jit
def inside_from(ux: f32, uy: f32, vx: f32, vy: f32, wx: f32, wy: f32, radius: f32) -> f32:
    """The cross product with each side (u, v, w) beyond which a pixel is inside: 0, or never without an area.

    A pixel centre on the extension of a face that is a line is zero to all its sides: rounding alone would
    decide whether it is inside.
    """
    longest2 = max(ux * ux + uy * uy, vx * vx + vy * vy, wx * wx + wy * wy)
    has_area = abs(ux * vy - uy * vx) > FLAT * (longest2 + math.sqrt(longest2) * radius)
    return ZERO if has_area else HUGE


@jit
def optical_depth(screen: Floats, faces: Ints, softness_px: f32, radius: f32, image: Floats) -> None:
    """Adds softplus(x_f(p)) of every face to `image` (H, W + LANES). screen (V, 3), faces (F, 3)."""
    height, width = image.shape[0], image.shape[1] - LANES
    scale = ONE / softness_px
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(screen[a, 2], screen[b, 2], screen[c, 2]) <= NEAREST_DEPTH:
            continue
        ax, ay, bx, by, cx, cy = (
            screen[a, 0],
            screen[a, 1],
            screen[b, 0],
            screen[b, 1],
            screen[c, 0],
            screen[c, 1],
        )
        x0 = max(0, math.floor(min(ax, bx, cx) - radius))
        x1 = min(width - 1, math.floor(max(ax, bx, cx) + radius))
        y0 = max(0, math.floor(min(ay, by, cy) - radius))
        y1 = min(height - 1, math.floor(max(ay, by, cy) + radius))
        ux, uy, vx, vy, wx, wy = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy
        iu = ONE / max(ux * ux + uy * uy, TINY)
        iv = ONE / max(vx * vx + vy * vy, TINY)
        iw = ONE / max(wx * wx + wy * wy, TINY)
        least = inside_from(ux, uy, vx, vy, wx, wy, radius)
        for y in range(y0, y1 + 1):
            py = f32(y) + HALF
            day, dby, dcy = py - ay, py - by, py - cy
            row = image[y]
            for start in range(x0, x1 + 1, LANES):
                run = row[start : start + LANES]
                left = f32(start) + HALF
                for k in range(LANES):
                    px = left + f32(k)
                    dax, dbx, dcx = px - ax, px - bx, px - cx
                    t = min(max((dax * ux + day * uy) * iu, ZERO), ONE)
                    qx, qy = dax - t * ux, day - t * uy
                    d2 = qx * qx + qy * qy
                    t = min(max((dbx * vx + dby * vy) * iv, ZERO), ONE)
                    qx, qy = dbx - t * vx, dby - t * vy
                    d2 = min(d2, qx * qx + qy * qy)
                    t = min(max((dcx * wx + dcy * wy) * iw, ZERO), ONE)
                    qx, qy = dcx - t * wx, dcy - t * wy
                    d2 = min(d2, qx * qx + qy * qy) * scale
                    cu, cv, cw = ux * day - uy * dax, vx * dby - vy * dbx, wx * dcy - wy * dcx
                    inside = (min(cu, cv, cw) > least) | (max(cu, cv, cw) < -least)
                    value = log1p_unit(exp_negative(d2)) + (d2 if inside else ZERO)
                    run[k] += value if (inside | (d2 < CUT)) else ZERO


@jit
def next_nonzero(grad: Floats, following: Ints) -> None:
    """following[y, x] = the first column >= x with a gradient worth following, or W. grad (H, W)."""
    height, width = grad.shape
    largest = ZERO
    for y in range(height):
        for x in range(width):
            largest = max(largest, abs(grad[y, x]))
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
    scale = ONE / softness_px
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(screen[a, 2], screen[b, 2], screen[c, 2]) <= NEAREST_DEPTH:
            continue
        ax, ay, bx, by, cx, cy = (
            screen[a, 0],
            screen[a, 1],
            screen[b, 0],
            screen[b, 1],
            screen[c, 0],
            screen[c, 1],
        )
        x0 = max(0, math.floor(min(ax, bx, cx) - radius))
        x1 = min(width - 1, math.floor(max(ax, bx, cx) + radius))
        y0 = max(0, math.floor(min(ay, by, cy) - radius))
        y1 = min(height - 1, math.floor(max(ay, by, cy) + radius))
        ux, uy, vx, vy, wx, wy = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy
        iu = ONE / max(ux * ux + uy * uy, TINY)
        iv = ONE / max(vx * vx + vy * vy, TINY)
        iw = ONE / max(wx * wx + wy * wy, TINY)
        least = inside_from(ux, uy, vx, vy, wx, wy, radius)
        gax, gay, gbx, gby, gcx, gcy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for y in range(y0, y1 + 1):
            py = f32(y) + HALF
            day, dby, dcy = py - ay, py - by, py - cy
            row = grad[y]
            start = following[y, x0] if x0 <= width else width
            while start <= x1:
                run = row[start : start + LANES]
                left = f32(start) + HALF
                for k in range(LANES):
                    px = left + f32(k)
                    dax, dbx, dcx = px - ax, px - bx, px - cx
                    # nearest point of the outline: offset q from it, weights (za, zb, zc) of the corners
                    t = min(max((dax * ux + day * uy) * iu, ZERO), ONE)
                    qx, qy = dax - t * ux, day - t * uy
                    d2 = qx * qx + qy * qy
                    za, zb, zc = ONE - t, t, ZERO
                    t = min(max((dbx * vx + dby * vy) * iv, ZERO), ONE)
                    rx, ry = dbx - t * vx, dby - t * vy
                    e2 = rx * rx + ry * ry
                    nearer = e2 < d2
                    d2 = e2 if nearer else d2
                    qx = rx if nearer else qx
                    qy = ry if nearer else qy
                    za = ZERO if nearer else za
                    zb = ONE - t if nearer else zb
                    zc = t if nearer else zc
                    t = min(max((dcx * wx + dcy * wy) * iw, ZERO), ONE)
                    rx, ry = dcx - t * wx, dcy - t * wy
                    e2 = rx * rx + ry * ry
                    nearer = e2 < d2
                    d2 = (e2 if nearer else d2) * scale
                    qx = rx if nearer else qx
                    qy = ry if nearer else qy
                    za = t if nearer else za
                    zb = ZERO if nearer else zb
                    zc = ONE - t if nearer else zc
                    cu, cv, cw = ux * day - uy * dax, vx * dby - vy * dbx, wx * dcy - wy * dcx
                    inside = (min(cu, cv, cw) > least) | (max(cu, cv, cw) < -least)
                    # dS/dx = sigmoid(x); dx/dcorner = -+ 2 q z / s
                    e = exp_negative(d2)
                    weight = (ONE if inside else -e) / (ONE + e) * run[k]
                    weight = weight if (inside | (d2 < CUT)) else ZERO
                    sx, sy = weight * qx, weight * qy
                    gax += sx * za
                    gay += sy * za
                    gbx += sx * zb
                    gby += sy * zb
                    gcx += sx * zc
                    gcy += sy * zc
                start += LANES
                start = following[y, start] if start < width else width
        outward = -TWO * scale
        out[a, 0] += outward * gax
        out[a, 1] += outward * gay
        out[b, 0] += outward * gbx
        out[b, 1] += outward * gby
        out[c, 0] += outward * gcx
        out[c, 1] += outward * gcy


@jit
def rasterize(
    screen: Floats, faces: Ints, depth: Floats, face_image: NDArray[np.int64], weight_image: Floats
) -> None:
    """Z-buffer of one view: writes depth (H, W), face index and perspective-correct weights (H, W, 3)."""
    height, width = face_image.shape
    depth[:] = HUGE
    face_image[:] = -1
    weight_image[:] = ZERO
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        az, bz, cz = screen[a, 2], screen[b, 2], screen[c, 2]
        if min(az, bz, cz) <= NEAREST_DEPTH:
            continue
        ax, ay, bx, by, cx, cy = (
            screen[a, 0],
            screen[a, 1],
            screen[b, 0],
            screen[b, 1],
            screen[c, 0],
            screen[c, 1],
        )
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) <= TINY:
            continue
        inverse_area = ONE / area
        x0 = max(0, math.floor(min(ax, bx, cx)))
        x1 = min(width - 1, math.floor(max(ax, bx, cx)))
        y0 = max(0, math.floor(min(ay, by, cy)))
        y1 = min(height - 1, math.floor(max(ay, by, cy)))
        ia, ib, ic = ONE / az, ONE / bz, ONE / cz
        for y in range(y0, y1 + 1):
            py = f32(y) + HALF
            for x in range(x0, x1 + 1):
                px = f32(x) + HALF
                wa = ((cx - bx) * (py - by) - (cy - by) * (px - bx)) * inverse_area
                wb = ((ax - cx) * (py - cy) - (ay - cy) * (px - cx)) * inverse_area
                wc = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) * inverse_area
                if min(wa, wb, wc) < ZERO:
                    continue
                z = ONE / (wa * ia + wb * ib + wc * ic)
                if z < depth[y, x]:
                    depth[y, x] = z
                    face_image[y, x] = f
                    weight_image[y, x, 0] = wa * ia * z
                    weight_image[y, x, 1] = wb * ib * z
                    weight_image[y, x, 2] = wc * ic * z


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
            bounded = max(sigma, LEAST_CONFIDENCE)
            clear = exp_negative(seen[y, width - 1 - x])
            clear_mirrored = exp_negative(mirrored[y, x])
            difference = clear_mirrored - clear  # flip(alpha) - alpha'
            total += sigma * difference * difference - cost * math.log(bounded)
            d_seen[y, width - 1 - x] = TWO * sigma * difference * clear
            d_mirrored[y, x] = -TWO * sigma * difference * clear_mirrored
            d_sigma = difference * difference - (cost / sigma if sigma >= LEAST_CONFIDENCE else ZERO)
            d_confidence[a] += wa * d_sigma
            d_confidence[b] += wb * d_sigma
            d_confidence[c] += wc * d_sigma
    return total
