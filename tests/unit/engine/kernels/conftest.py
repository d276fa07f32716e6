"""Random faces on the screen, by what is awkward about them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from refine_engine.cameras.project import project, stack
from refine_engine.values import Camera


@dataclass(frozen=True)
class Scene:
    screen: Tensor  # (B, V, 3)
    faces: Tensor  # (F, 3)
    ties: bool = False  # sides of one face lie on one another


def ordinary(side: int, random: torch.Generator) -> Scene:
    """Small and large faces, both windings, some partly outside the image."""
    centre = torch.rand(40, 1, 2, generator=random) * side
    size = side * (0.05 + 0.5 * torch.rand(40, 1, 1, generator=random))
    corners = centre + size * torch.randn(40, 3, 2, generator=random)
    return separate(torch.cat([corners, 1 + torch.rand(40, 3, 1, generator=random)], -1))


def degenerate(side: int, random: torch.Generator) -> Scene:
    """A repeated index, a repeated position, three corners in a line, a face that is a point."""
    points = torch.rand(30, 3, generator=random) * side
    points[:, 2] = 1 + torch.rand(30, generator=random)
    points[1] = points[0]
    points[5] = (points[3] + points[4]) / 2
    points[8] = points[7] = points[6]
    awkward = torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 9, 10], [11, 11, 11]])
    return Scene(points[None], torch.cat([awkward, torch.arange(12, 30).reshape(-1, 3)]), ties=True)


def edge_on(side: int, random: torch.Generator) -> Scene:
    """Faces that the camera sees as a line: across, upright, and slanted up to rounding."""
    along = torch.rand(24, 3, generator=random) * side
    slope = torch.rand(24, 1, generator=random)
    slope[:6] = 0
    x, y = along, side / 4 + slope * along
    upright = torch.arange(24)[:, None] % 4 == 3
    x, y = torch.where(upright, y, x), torch.where(upright, x, y)
    depth = 1 + torch.rand(24, 3, generator=random)
    scene = separate(torch.stack([x, y, depth], -1))
    return replace(scene, ties=True)


def seen_by_cameras(side: int, random: torch.Generator, spread: float, distance: float) -> Scene:
    points = spread * torch.randn(60, 3, generator=random)
    cameras = [Camera.look_at(azimuth, 20, distance, 60, side, side) for azimuth in (0, 130, 250)]
    faces = torch.randint(0, 60, (40, 3), generator=random)
    return Scene(project(points, *stack(cameras, torch.device("cpu"))), faces)


def behind(side: int, random: torch.Generator) -> Scene:
    """Cameras inside the cloud of points: about half of the vertices are behind each."""
    return seen_by_cameras(side, random, 1.0, 0.2)


def near_plane(side: int, random: torch.Generator) -> Scene:
    """Depths on both sides of the least that is drawn, and one on it."""
    corners = ordinary(side, random)
    corners.screen[..., 2] = 0.005 + 0.06 * torch.rand(1, 120, generator=random)
    corners.screen[0, 0, 2] = 0.01
    return corners


def off_screen(side: int, random: torch.Generator) -> Scene:
    """Faces around the image: some reach into it, some lie next to it, most are far away."""
    scene = ordinary(side, random)
    away = torch.randint(-1, 2, (40, 1, 2), generator=random) * side * torch.rand(40, 1, 1, generator=random)
    scene.screen[..., :2] += 2 * away.expand(40, 3, 2).reshape(1, 120, 2)
    return scene


def several_views(side: int, random: torch.Generator) -> Scene:
    return seen_by_cameras(side, random, 0.3, 1.9)


def separate(corners: Tensor) -> Scene:
    """Faces that share no vertex, from (F, 3, 3)."""
    return Scene(corners.reshape(1, -1, 3), torch.arange(3 * len(corners)).reshape(-1, 3))


KINDS: tuple[Callable[[int, torch.Generator], Scene], ...] = (
    ordinary, degenerate, edge_on, behind, near_plane, off_screen, several_views,
)  # fmt: skip


@pytest.fixture(params=KINDS, ids=lambda kind: kind.__name__)
def make_scene(request: pytest.FixtureRequest) -> Callable[[int], Scene]:
    """A function of the image side; the same scene for the same side."""
    return lambda side: request.param(side, torch.Generator().manual_seed(side))


@pytest.fixture
def views() -> Scene:
    """Forty faces seen by three cameras in 32 x 32 pixels."""
    return several_views(32, torch.Generator().manual_seed(1))
