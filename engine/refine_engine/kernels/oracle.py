"""The specification of the renderer, computed in plain torch. Slow, obvious, differentiable by autograd.

For a pixel centre p and the screen triangle of face f, let d^2 be the squared distance from p to the
triangle's outline in pixels, and

    x_f(p) = +d^2 / s if p is inside, -d^2 / s outside,     s = softness * (side / 2)^2
    S(p) = sum over f of softplus(x_f(p))                   "optical depth"
    alpha(p) = 1 - prod over f of (1 - sigmoid(x_f(p))) = 1 - exp(-S(p))

which is the soft silhouette of Liu et al. 2019 (Soft Rasterizer): its product over faces, carried as a sum
that needs no order and no list of the K nearest faces, and never saturates. A face is left out of a pixel
where sigmoid(x) falls below 1e-4, and of the image when one of its vertices is nearer to the camera plane
than NEAR. A triangle without area (`orientation`) is its outline: it has no inside.

At a pixel centre inside a face, let w_i be the share of its screen triangle that lies opposite corner i, and
z_i the corner's depth. A point of the face is a mean of the corners with weights in proportion to

    w_i / z_i  in perspective,  w_i  in an orthographic view

and its depth is their mean with the same weights. The visible face is the one of the least depth.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from .fragments import Fragments

CUTOFF = math.log(1e4 - 1)  # -x where sigmoid(x) = 1e-4
LEAST_CONFIDENCE = 1e-6  # below it ln(1 / sigma) grows no more
NEAR = 1e-2  # least depth of a drawn vertex, in the unit of the depths: callers scale the object to length 1
FLAT = 1e-6  # several roundings of float32: area that counts as none, see `orientation`
FACES_AT_ONCE = 64  # bounds the memory of the dense evaluation


def drawable(screen: Tensor, faces: Tensor) -> Tensor:
    """(B, F) bool: all vertices in front of the camera and finite."""
    corners = screen[:, faces]  # (B, F, 3, 3)
    return (corners[..., 2] > NEAR).all(-1) & torch.isfinite(corners).all(-1).all(-1)


def pixel_centres(height: int, width: int, like: Tensor) -> Tensor:
    """(H, W, 2) x, y."""
    y = torch.arange(height, dtype=like.dtype, device=like.device) + 0.5
    x = torch.arange(width, dtype=like.dtype, device=like.device) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """z of the cross product of vectors in the plane: (..., 2), (..., 2) -> (...). Positive from +x to +y."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def orientation(triangles: Tensor, reach: float) -> Tensor:
    """+1 where the corners turn from +x to +y, -1 the other way, 0 without an area: (F, 3, 2) -> (F,).

    A point on the extension of a face that is a line is zero to all its sides: rounding alone would decide
    whether it is inside. So twice the area must be more than FLAT times the longest side times that side and
    `reach`, which is how far from the face points are asked about, pixels.
    """
    sides = triangles.roll(-1, 1) - triangles  # (F, 3, 2)
    longest = sides.square().sum(-1).amax(1).sqrt()
    area = cross(sides[:, 0], sides[:, 1])
    return torch.where(area.abs() > FLAT * longest * (longest + reach), area.sign(), 0)


def signed_squared_distance(p: Tensor, triangles: Tensor, reach: float) -> Tensor:
    """p (P, 2), triangles (F, 3, 2) -> (F, P): squared distance to the outline, positive inside.

    Right within `reach` of a face; see `orientation`.
    """
    squared, sides = [], []
    for i in range(3):
        a = triangles[:, None, i]  # (F, 1, 2)
        edge = triangles[:, None, (i + 1) % 3] - a
        to_p = p[None] - a  # (F, P, 2)
        length2 = (edge * edge).sum(-1)
        t = ((to_p * edge).sum(-1) / length2.clamp_min(1e-12)).clamp(0, 1).detach()  # stationary: no gradient
        squared.append((to_p - t[..., None] * edge).square().sum(-1))
        sides.append(cross(edge, to_p))
    inside = (torch.stack(sides) * orientation(triangles, reach)[:, None] > 0).all(0)
    nearest = torch.stack(squared).amin(0)
    return torch.where(inside, nearest, -nearest)


def optical_depth(screen: Tensor, faces: Tensor, side: int, softness: float) -> Tensor:
    """S (B, side, side) of the specification above."""
    s = softness * (side / 2) ** 2  # squared pixels
    p = pixel_centres(side, side, screen).reshape(-1, 2)
    images = []
    for points, ok in zip(screen, drawable(screen, faces), strict=True):
        total = torch.zeros(len(p), dtype=screen.dtype, device=screen.device)
        for chunk in faces[ok].split(FACES_AT_ONCE):
            x = signed_squared_distance(p, points[chunk][..., :2], math.sqrt(CUTOFF * s)) / s
            total = total + torch.where(x > -CUTOFF, F.softplus(x, threshold=80), 0).sum(0)
        images.append(total.reshape(side, side))
    return torch.stack(images)


def rasterize(screen: Tensor, faces: Tensor, size: tuple[int, int], orthographic: bool = False) -> Fragments:
    """The nearest face at each pixel centre that lies inside it, by comparing all of them."""
    p = pixel_centres(*size, screen).reshape(-1, 2)
    face_images, weight_images = [], []
    for points, ok in zip(screen, drawable(screen, faces), strict=True):
        best_depth = torch.full((len(p),), math.inf, dtype=screen.dtype, device=screen.device)
        best_face = torch.full((len(p),), -1, dtype=torch.int64, device=screen.device)
        best_weight = torch.zeros(len(p), 3, dtype=screen.dtype, device=screen.device)
        for index in ok.nonzero()[:, 0].split(FACES_AT_ONCE):
            weights, depths = hits(p, points[faces[index]], orthographic)  # (C, P, 3), (C, P)
            nearest, which = depths.min(0)
            closer = nearest < best_depth
            best_depth = torch.where(closer, nearest, best_depth)
            best_face = torch.where(closer, index[which], best_face)
            weight = weights[which, torch.arange(len(p), device=p.device)]
            best_weight = torch.where(closer[:, None], weight, best_weight)
        face_images.append(best_face.reshape(size))
        weight_images.append(best_weight.reshape(*size, 3))
    return Fragments(torch.stack(face_images), torch.stack(weight_images))


def hits(p: Tensor, triangles: Tensor, orthographic: bool) -> tuple[Tensor, Tensor]:
    """Of points p (P, 2) on triangles (F, 3, 3): weights of the corners (F, P, 3) and depth (F, P).

    The depth is infinite where the point is outside the face.
    """
    corners = triangles[..., :2]
    a, b, c = (corners[:, None, i] for i in range(3))  # (F, 1, 2)
    areas = torch.stack([cross(c - b, p - b), cross(a - c, p - c), cross(b - a, p - a)], -1)  # twice
    turn = orientation(corners, reach=0)[:, None]  # (F, 1)
    share = areas * turn[..., None]  # (F, P, 3), none negative inside
    inside = (share >= 0).all(-1) & (turn != 0)
    z = triangles[:, None, :, 2]
    if not orthographic:
        share = share / z
    weights = share / torch.where(inside, share.sum(-1), 1)[..., None]
    return weights, torch.where(inside, (weights * z).sum(-1), math.inf)


def alpha(optical_depth: Tensor) -> Tensor:
    """Soft silhouette 1 - exp(-S)."""
    return -torch.expm1(-optical_depth)


def confidence_cost(confidence: Tensor, cost: float) -> Tensor:
    """lambda_B ln(1 / sigma): what it costs to call a place asymmetric."""
    return -cost * torch.log(confidence.clamp_min(LEAST_CONFIDENCE))


def image_symmetry(
    seen: Tensor,  # (B, N, N) optical depth at the cameras p
    mirrored: Tensor,  # (B, N, N) optical depth at the reflected cameras T p
    confidence: Tensor,  # (B, N, N) sigma on the visible faces at T p
    covered: Tensor,  # (B, N, N) 1 where a face is visible at T p
    cost: float,
) -> Tensor:
    """Mean over pairs and pixels of sigma (flip(alpha at p) - alpha at T p)^2 + lambda_B ln(1 / sigma)."""
    difference = (alpha(seen).flip(-1) - alpha(mirrored)).square()
    return (covered * (confidence * difference + confidence_cost(confidence, cost))).mean()


def nearest_point(points: Tensor, queries: Tensor) -> Tensor:
    """Index (Q,) of the nearest of the points (P, 3) for each query (Q, 3), by comparing all pairs."""
    return torch.cdist(queries, points).argmin(1)
