"""One mesh, silhouette and camera in small pictures, and the readings of the camera that fit better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from refine_proto.cameras import CameraSpec
from refine_proto.checks import Reading

from ..cameras.readings import other_readings
from ..cameras.seen import seen_by
from ..cameras.spec import spec_of
from ..method.symmetry import surface_points
from ..values import Camera, Mesh, View

LOW_IOU = 0.4  # a coarse mesh seen by its true camera overlaps more than this
BETTER_IOU = 0.1  # by which another reading has to be better: symmetric objects have equals
EQUAL_IOU = 0.01  # of readings that fit alike the likelier one is named
OUTLINE_IOU = 0.85  # of pictures scaled to one box: their outlines differ in their proportions only
OUTLINE_GAIN = 0.05  # of it: less, and it is the proportions of the mesh that are wrong, not the camera
OUTLINE_SIDE = 64  # pixels of that box
BACKGROUND_BORDER = 0.5  # share of the image's border that is object when object and background are swapped
FULL = 0.95  # share of the image
INSIDE = 0.01  # share of the surface that may be behind a camera that is not inside
LONGEST_SIDE = 224  # of the images compared, pixels
SHORTEST_OBJECT = 48  # pixels of the silhouette in them, if the image has so many
LARGEST_SIDE = 896  # of the images compared for its sake
MANY_FACES = 20_000  # a mesh with more is thinned out before it is drawn so often
CELLS = 96  # of its longest side, when it is
BATCH = 8  # readings drawn at a time


@dataclass(frozen=True)
class Look:
    """One mesh, silhouette and camera, and what low-resolution pictures of them say."""

    mesh: Mesh
    view: View
    spec: CameraSpec

    @property
    def camera(self) -> Camera:
        return self.view.camera

    @cached_property
    def object(self) -> Tensor:
        """(H, W) bool, the silhouette as it came, where it is known."""
        return self.view.object()

    @cached_property
    def extent(self) -> int:
        """Longest side of the silhouette's bounding box, pixels."""
        rows, columns = self.object.any(1).nonzero()[:, 0], self.object.any(0).nonzero()[:, 0]
        return max(int(rows[-1] - rows[0]), int(columns[-1] - columns[0])) + 1

    @cached_property
    def silhouette(self) -> Tensor:
        """(h, w) bool, small; of what is known."""
        return self._small(self.object)

    @cached_property
    def known(self) -> Tensor | None:
        """(h, w) bool, small: the pixels that say something; None: all of them."""
        return None if self.view.known is None else self._small(self.view.known)

    def _small(self, picture: Tensor) -> Tensor:
        height, width = picture.shape
        side = min(max(LONGEST_SIDE, SHORTEST_OBJECT * max(height, width) / self.extent), LARGEST_SIDE)
        scale = min(1.0, side / max(height, width))
        size = (max(1, round(height * scale)), max(1, round(width * scale)))
        return F.adaptive_avg_pool2d(picture.float()[None], size)[0] > 0.5

    @cached_property
    def covered(self) -> float:
        """Share of the image that is object, of what is known."""
        known = self.object.numel() if self.view.known is None else int(self.view.known.sum())
        return float(self.object.sum()) / known

    @cached_property
    def thin(self) -> Mesh:
        return thinned(self.mesh)

    @cached_property
    def rendered(self) -> Tensor:
        """Which of these pixels the mesh covers."""
        return self._drawn([self.camera])[0]

    @cached_property
    def iou(self) -> float:
        return float(_iou(self.rendered, self.silhouette))

    @cached_property
    def background_iou(self) -> float:
        """Of the mesh with what is not object."""
        background = ~self.silhouette if self.known is None else ~self.silhouette & self.known
        return float(_iou(self.rendered, background))

    @cached_property
    def inverted(self) -> bool:
        """Whether the mesh is where the silhouette is not, and the silhouette is around it."""
        s = self.silhouette
        border = torch.cat([s[0], s[-1], s[:, 0], s[:, -1]])
        around = float(border.float().mean()) > BACKGROUND_BORDER
        return around and self.background_iou > self.iou

    @cached_property
    def reading(self) -> Reading | None:
        """The reading of the camera that fits better than the given one by BETTER_IOU, if there is one."""
        if self.iou + BETTER_IOU >= 1.0 or self.inverted or self.covered > FULL:
            return None
        readings = other_readings(self.spec, self.camera)
        cameras = list(readings.values())
        pictures = [
            picture
            for start in range(0, len(cameras), BATCH)
            for picture in self._drawn(cameras[start:][:BATCH])
        ]
        scores = [float(_iou(picture, self.silhouette)) for picture in pictures]
        best = max(scores)
        if best <= self.iou + BETTER_IOU or best < LOW_IOU:
            return None
        at = next(i for i, score in enumerate(scores) if score >= best - EQUAL_IOU)
        if _turned_only(self.camera, cameras[at]) and self._proportions_only(pictures[at]):
            return None
        name = list(readings)[at]
        return Reading(name=name, silhouette_iou=round(scores[at], 3), camera=spec_of(cameras[at]))

    def _proportions_only(self, picture: Tensor) -> bool:
        """Whether the given camera's picture has the silhouette's outline as the other `picture` has it."""
        wanted = _in_one_box(self.silhouette)
        given, other = (float(_iou(_in_one_box(drawn), wanted)) for drawn in (self.rendered, picture))
        return given >= OUTLINE_IOU and other < given + OUTLINE_GAIN

    @property
    def hint(self) -> str:
        """What is likely meant, for the end of a message."""
        if self.reading is None:
            return ""
        return f"; did you mean {self.reading.name}? it gives a 2D IoU of {self.reading.silhouette_iou:.2f}"

    def _drawn(self, cameras: Sequence[Camera]) -> Tensor:
        """Which known pixels the mesh covers: (B, h, w) bool."""
        size = (self.silhouette.shape[0], self.silhouette.shape[1])
        drawn = seen_by(self.thin, cameras, size).face >= 0
        return drawn if self.known is None else drawn & self.known


def is_inside(mesh: Mesh, camera: Camera) -> bool:
    """Whether the camera is in the surface's box with some of it behind. Stray fragments do not count."""
    points = surface_points(mesh, 1000)
    pose = camera.world_to_camera.double().cpu()
    eye = -pose[:3, :3].T @ pose[:3, 3]
    low, high = points.quantile(INSIDE, 0), points.quantile(1 - INSIDE, 0)
    behind = float((points @ pose[2, :3] + pose[2, 3] <= 0).double().mean())
    return bool(((low < eye) & (eye < high)).all()) and behind > INSIDE


def whereabouts(mesh: Mesh, camera: Camera) -> str:
    """Of a mesh that the camera does not see: where it is instead."""
    vertices = mesh.vertices[mesh.faces.unique()]
    depth = vertices @ camera.world_to_camera[2, :3].to(vertices) + camera.world_to_camera[2, 3].to(vertices)
    nearest, farthest = float(depth.min()), float(depth.max())
    if farthest <= 0.0:
        return "one that is entirely behind the camera"
    if nearest <= 0.0:
        return f"one around the camera, from depth {nearest:.3g} to {farthest:.3g}"
    low, high = drawn_box(mesh, camera)
    image = f"the {camera.width}x{camera.height} pixels"
    inside = bool((high > 0).all()) and bool((low < low.new_tensor([camera.width, camera.height])).all())
    if inside:
        return f"one of {float((high - low).max()):.2g} pixels, which covers the middle of none of {image}"
    return f"one that lies outside {image}"


def drawn_box(mesh: Mesh, camera: Camera) -> tuple[Tensor, Tensor]:
    """Least and largest pixel coordinates (2,) of a mesh in front of the camera; 1 % of it may be outside."""
    pose = camera.world_to_camera.double().cpu()
    points = surface_points(mesh, 1000) @ pose[:3, :3].T + pose[:3, 3]
    depth = points[:, 2:].clamp_min(1e-9) if camera.projection == "perspective" else 1.0
    lens = points.new_tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]])
    screen = points[:, :2] / depth * lens[0] + lens[1]
    return screen.quantile(0.01, 0), screen.quantile(0.99, 0)


def thinned(mesh: Mesh, many_faces: int = MANY_FACES, cells_along: int = CELLS) -> Mesh:
    """The mesh, or, of one with many faces, what is left when its vertices snap to a grid of cells.

    Drawn at LONGEST_SIDE both look the same to about a pixel with CELLS along the longest side. A stray
    fragment does not make the cells larger.
    """
    if len(mesh.faces) <= many_faces:
        return mesh
    points = surface_points(mesh, 1000).to(mesh.vertices)
    low, high = points.quantile(0.01, 0), points.quantile(0.99, 0)
    cell = float((high - low).max()) / cells_along
    snapped = ((mesh.vertices - low) / cell).round().clamp(-(2**20), 2**20 - 1).long() + 2**20
    key = (snapped[:, 0] << 42) | (snapped[:, 1] << 21) | snapped[:, 2]
    cells, cell_of = key.unique(return_inverse=True)
    faces = cell_of[mesh.faces].sort(1).values
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2])]
    count = len(cells)
    unique = ((faces[:, 0] * count + faces[:, 1]) * count + faces[:, 2]).unique()
    if len(unique) == 0:
        return mesh
    faces = torch.stack([unique // count // count, unique // count % count, unique % count], 1)
    centres = torch.stack([cells >> 42, (cells >> 21) & (2**21 - 1), cells & (2**21 - 1)], 1) - 2**20
    return Mesh(centres.to(mesh.vertices) * cell + low, faces)


def _iou(rendered: Tensor, silhouette: Tensor) -> Tensor:
    """2D IoU of two pictures (h, w) bool."""
    return (rendered & silhouette).sum() / (rendered | silhouette).sum().clamp_min(1)


def _in_one_box(picture: Tensor) -> Tensor:
    """What is covered of a picture (h, w) bool, stretched to a square: empty if nothing is."""
    if not picture.any():
        return picture.new_zeros(OUTLINE_SIDE, OUTLINE_SIDE)
    rows, columns = picture.any(1).nonzero()[:, 0], picture.any(0).nonzero()[:, 0]
    cut = picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].float()
    return F.interpolate(cut[None, None], (OUTLINE_SIDE, OUTLINE_SIDE), mode="bilinear")[0, 0] > 0.5


def _turned_only(one: Camera, other: Camera) -> bool:
    """Whether two cameras have the same lens and are as far from the world's origin."""
    a, b = (camera.world_to_camera[:3, 3].norm() for camera in (one, other))
    return one.fx == other.fx and one.cx == other.cx and bool(torch.isclose(a, b, rtol=1e-3))
