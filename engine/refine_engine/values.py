"""What the engine works on: Mesh, Camera, View, Progress, Result. Frozen, and checked here once.

Letters: V vertices, F faces, B views, H W image. World: right-handed, Y up. Camera: +X right, +Y down,
+Z forward (OpenCV). Pixels: origin top left, centres at +0.5. See docs/conventions.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from .errors import CameraInvalid, MeshInvalid, SilhouetteInvalid

Projection = Literal["perspective", "orthographic"]
RIGID = 4e-3  # of R R^T - I: what is within 1e-3, as the contract asks, still is once transposed or inverted


STRAY = 4.0  # times the span of 99 % of the surface, per axis


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh. It may be open, non-manifold, badly wound or in several pieces."""

    vertices: Tensor  # (V, 3) float32, world units
    faces: Tensor  # (F, 3) int64, indices into vertices

    def __post_init__(self) -> None:
        v, f = self.vertices, self.faces
        if v.ndim != 2 or v.shape[1] != 3 or v.dtype != torch.float32:
            raise MeshInvalid(f"expected vertices (V, 3) float32, got {tuple(v.shape)} {v.dtype}")
        if f.ndim != 2 or f.shape[1] != 3 or f.dtype != torch.int64:
            raise MeshInvalid(f"expected faces (F, 3) int64, got {tuple(f.shape)} {f.dtype}")
        if len(f) == 0:
            raise MeshInvalid("expected at least one triangle, got a mesh without faces")
        if not torch.isfinite(v).all():
            raise MeshInvalid(f"expected finite vertex positions, got NaN or infinity in {_bad_rows(v)}")
        if int(f.min()) < 0 or int(f.max()) >= len(v):
            raise MeshInvalid(
                f"expected face indices from 0 to {len(v) - 1}, got {int(f.min())} to {int(f.max())}"
            )
        used = v[f.unique()]
        if float((used.amax(0) - used.amin(0)).max()) <= 0.0:
            raise MeshInvalid("expected an object with a size, got one whose vertices all coincide")

    def box(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner (3,) of the bounding box of the triangles.

        Where fragments stretch it beyond STRAY times what nearly all of the surface spans, they are left
        out: a crumb far away must not make the object a point. Found once for a mesh.
        """
        return self._box

    @cached_property
    def _box(self) -> tuple[Tensor, Tensor]:
        used = self.vertices[self.faces.unique()]
        low, high = used.amin(0), used.amax(0)
        corners = self.vertices[self.faces].double()
        a, b, c = corners.unbind(1)
        area = torch.linalg.cross(b - a, c - a).norm(dim=1)
        middle = corners.mean(1)
        order = middle.argsort(0)
        share = area[order].cumsum(0) / area.sum().clamp_min(1e-300)
        inner = ((share > 0.005) & (share < 0.995)).to(torch.int64)
        if not inner.any(0).all():
            return low, high
        first, last = inner.argmax(0), len(inner) - 1 - inner.flip(0).argmax(0)
        ordered = middle.gather(0, order)
        core_low, core_high = (ordered.gather(0, rank[None])[0] for rank in (first, last))
        core = (core_high - core_low).max()
        if core <= 0.0 or (high - low).max() <= STRAY * core:
            return low, high
        near = ((middle >= core_low - core) & (middle <= core_high + core)).all(1)
        kept = self.vertices[self.faces[near].unique()]
        return kept.amin(0), kept.amax(0)

    def to(self, device: torch.device | str) -> Mesh:
        """This mesh on a device; itself if it is there."""
        if self.vertices.device == self.faces.device == torch.device(device):
            return self
        return Mesh(self.vertices.to(device), self.faces.to(device))


def _bad_rows(vertices: Tensor) -> str:
    rows = (~torch.isfinite(vertices)).any(1).nonzero()[:, 0].tolist()
    return f"{len(rows)} of {len(vertices)} vertices (first: {rows[0]})"


@dataclass(frozen=True)
class Camera:
    """A camera in the one internal form. `fx fy cx cy` are in pixels of a `width` x `height` image;
    for an orthographic camera fx and fy are pixels per world unit."""

    world_to_camera: Tensor  # (4, 4) float32, OpenCV axes
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    projection: Projection = "perspective"

    def __post_init__(self) -> None:
        m = self.world_to_camera
        if m.shape != (4, 4) or not torch.isfinite(m).all():
            raise CameraInvalid(f"expected a finite 4x4 world_to_camera, got shape {tuple(m.shape)}")
        rotation = m[:3, :3].double()
        error = float(
            (rotation @ rotation.T - torch.eye(3, dtype=torch.float64, device=m.device)).abs().max()
        )
        if error > RIGID:
            raise CameraInvalid(
                f"expected an orthonormal rotation in world_to_camera, got one that is off by {error:.3g} "
                "(a scale or a shear? remove it, or check row-major order)"
            )
        if float(torch.linalg.det(rotation)) < 0.0:
            raise CameraInvalid(
                "expected a right-handed world_to_camera (determinant +1), got a mirrored one (-1)"
            )
        if not (self.fx > 0 and self.fy > 0 and math.isfinite(self.fx + self.fy + self.cx + self.cy)):
            raise CameraInvalid(
                f"expected finite intrinsics with positive fx, fy, got fx={self.fx} fy={self.fy}"
            )
        if self.width < 1 or self.height < 1:
            raise CameraInvalid(f"expected a positive image size, got {self.width}x{self.height}")

    @staticmethod
    def look_at(
        azimuth_degrees: float,
        elevation_degrees: float,
        distance: float,
        fov_y_degrees: float,
        width: int,
        height: int,
    ) -> Camera:
        """A camera at distance * (cos e sin a, sin e, cos e cos a) that looks at the origin, up +Y.

        The same as PyTorch3D's `look_at_view_transform`. Straight up or down (elevation +-90) the image's
        up direction is the limit of the elevation, so it is defined there too.
        """
        a, e = math.radians(azimuth_degrees), math.radians(elevation_degrees)
        forward = [-math.cos(e) * math.sin(a), -math.sin(e), -math.cos(e) * math.cos(a)]
        right = [math.cos(a), 0.0, -math.sin(a)]
        down = [
            forward[1] * right[2] - forward[2] * right[1],
            forward[2] * right[0] - forward[0] * right[2],
            forward[0] * right[1] - forward[1] * right[0],
        ]
        rows = [[*right, 0.0], [*down, 0.0], [*forward, distance], [0.0, 0.0, 0.0, 1.0]]
        f = focal_length(fov_y_degrees, height)
        return Camera(torch.tensor(rows), f, f, width / 2, height / 2, width, height)


def focal_length(fov_degrees: float, pixels: int) -> float:
    """Pixels: of an image that sees so much over `pixels` of its height, or of its width."""
    return 0.5 * pixels / math.tan(math.radians(fov_degrees) / 2)


def field_of_view(focal: float, pixels: int) -> float:
    """Degrees: what `focal_length` undoes."""
    return math.degrees(2 * math.atan(0.5 * pixels / focal))


@dataclass(frozen=True)
class View:
    """One observation: the object's silhouette and the camera that saw it."""

    silhouette: Tensor  # (H, W) float32, 1 object, 0 background
    camera: Camera
    known: Tensor | None = None  # (H, W) bool: the pixels that say something; None: all of the image

    def __post_init__(self) -> None:
        s, c = self.silhouette, self.camera
        if s.ndim != 2 or s.dtype != torch.float32:
            raise SilhouetteInvalid(f"expected a silhouette (H, W) float32, got {tuple(s.shape)} {s.dtype}")
        if tuple(s.shape) != (c.height, c.width):
            raise SilhouetteInvalid(
                f"expected a silhouette of the camera's size {c.width}x{c.height}, "
                f"got {s.shape[1]}x{s.shape[0]}"
            )
        seen = s
        if self.known is not None:
            if self.known.shape != s.shape or self.known.dtype != torch.bool:
                raise SilhouetteInvalid(
                    f"expected known pixels {tuple(s.shape)} bool, got {tuple(self.known.shape)} "
                    f"{self.known.dtype}"
                )
            seen = s[self.known]
            if len(seen) == 0:
                raise SilhouetteInvalid("expected pixels that are known, got none")
        covered = float((seen > 0.5).float().mean())
        if covered == 0.0:
            raise SilhouetteInvalid("expected an object in the silhouette, got no pixel above the threshold")
        if covered == 1.0:
            raise SilhouetteInvalid(
                "expected background around the object, got a silhouette that is all object"
            )

    def to(self, device: torch.device | str) -> View:
        """This view with its pixels on a device; a camera's few numbers follow when they are used."""
        known = None if self.known is None else self.known.to(device)
        return View(self.silhouette.to(device), self.camera, known)

    def object(self) -> Tensor:
        """(H, W) bool: the pixels of the object that are known."""
        wanted = self.silhouette > 0.5
        return wanted if self.known is None else wanted & self.known


@dataclass(frozen=True)
class MirrorPlane:
    """The plane normal . x = offset, world frame."""

    normal: Tensor  # (3,) unit
    offset: float  # world units
    error: float | None  # mean distance of the mirrored surface to the surface, longest sides; None: given

    def moved_to(self, offset: float) -> MirrorPlane:
        """The parallel plane there."""
        return replace(self, offset=offset)


Outcome = Literal["refined", "fitted", "kept"]
"""What a run hands back: the network's best iterate, the mesh moved as a whole, or the coarse mesh."""


@dataclass(frozen=True)
class Progress:
    """What `report` receives after an iteration."""

    iteration: int  # 1 ... total
    total: int
    losses: Mapping[str, float]  # weighted terms by name, and "total"
    silhouette_iou: float  # 2D IoU of the current iterate, from its soft silhouette at one half


@dataclass(frozen=True)
class Proxy:
    """The small mesh that was optimised instead of one with many vertices."""

    vertices: int
    faces: int
    silhouette_iou_after: float  # of itself, refined


@dataclass(frozen=True)
class Result:
    """What `refine` returns, in the world units of the input mesh."""

    mesh: Mesh  # the input's vertices, refined, and those of its faces that are kept
    kept_faces: Tensor  # (F,) bool, over the input's faces
    displacement: Tensor  # (V, 3) world units
    confidence: Tensor  # (V,) symmetry confidence in [0, 1]
    best_iteration: int  # of the network, 1-based; 0: none was returned
    loss_curve: Mapping[str, Sequence[float]]  # weighted terms and "total" per iteration
    silhouette_iou_before: float  # hard render of the coarse mesh against the input silhouette
    silhouette_iou_after: float
    outcome: Outcome
    plane: MirrorPlane | None  # the mirror plane that was used; None: the object has none
    camera_turn_degrees: (
        float | None
    )  # by which the cameras were turned about the object; None: they were not
    seconds: float
    warnings: tuple[str, ...] = ()
    proxy: Proxy | None = None  # None: the input itself was optimised
