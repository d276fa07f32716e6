"""The camera at the side of the preview."""

import math
from dataclasses import replace

import pytest
import torch

from refine_engine.artifacts.pictures import side_camera
from refine_engine.cameras.project import project, stack
from refine_engine.values import Camera, Mesh

PIXELS = 100
CPU = torch.device("cpu")
TABLE = Mesh(
    torch.tensor([[0.0, 0, 0], [0, 1, 0], [2, 1, 0], [2, 1, 3], [0, 1, 3]]) + torch.tensor([5.0, -2, 1]),
    torch.tensor([[0, 1, 2], [1, 2, 3], [1, 3, 4]]),
)  # its first edge is upright
VIEWS = [(0, 0), (62, 20), (118, 45), (200, -15), (30, 80), (75, 90), (10, -90)]


def rolled(camera: Camera, degrees: float) -> Camera:
    """The camera turned about its viewing direction."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = torch.tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return replace(camera, world_to_camera=turn @ camera.world_to_camera)


@pytest.mark.parametrize("roll", [0, 90, -20])
@pytest.mark.parametrize(("azimuth", "elevation"), VIEWS)
def test_the_side_shows_the_whole_mesh_upright(azimuth: float, elevation: float, roll: float) -> None:
    camera = rolled(Camera.look_at(azimuth, elevation, 9.0, 60, 64, 48), roll)
    side = side_camera(camera, TABLE, PIXELS)
    assert (side.width, side.height) == (PIXELS, PIXELS)
    assert float(side.world_to_camera[0, 1]) == pytest.approx(0, abs=1e-6)  # its rows are level
    screen = project(TABLE.vertices, *stack([side], CPU))[0]
    assert float(screen[:, :2].min()) > 5
    assert float(screen[:, :2].max()) < PIXELS - 5
    foot, head = screen[0], screen[1]
    assert float(foot[1] - head[1]) > 10  # up is up


@pytest.mark.parametrize(("azimuth", "elevation"), VIEWS)
def test_the_side_is_a_quarter_turn_around_the_up_axis(azimuth: float, elevation: float) -> None:
    camera = Camera.look_at(azimuth, elevation, 9.0, 60, 64, 48)
    forward, aside = camera.world_to_camera[2, :3], side_camera(camera, TABLE, PIXELS).world_to_camera[2, :3]
    assert float(forward[0] * aside[0] + forward[2] * aside[2]) == pytest.approx(0, abs=1e-5)
    steepest = max(-30.0, min(30.0, elevation))
    assert math.degrees(math.asin(-float(aside[1]))) == pytest.approx(steepest, abs=1e-3)


def test_the_side_is_the_one_at_the_left_of_the_picture() -> None:
    """What is left as the camera sees it is near as the side sees it, what is near is right."""
    camera = Camera.look_at(0, 0, 9.0, 60, 64, 48)
    side = side_camera(camera, TABLE, PIXELS)
    left, right, near, far = project(TABLE.vertices[[1, 2, 4, 1]], *stack([side], CPU))[0]
    assert left[2] < right[2]
    assert near[0] > far[0]
