"""The networks: an image of 64 x 64 to occupancy on a grid of 40^3 in the object's frame.

As occupancy networks do (Mescheder et al. 2019), both predict in the frame in which all their objects stand
alike, not in the camera's, from one code for the whole object, with 2.1 million numbers. `image` knows the
image alone, and so its mesh agrees with the silhouette only as well as it has understood the object.
`camera`, as DISN (Xu et al. 2019), is told the camera and also looks up, on a coarse grid, what the image
shows at each place: its outline is nearly right, and its errors lie along the view. The decoder is
convolutional: on a CPU a whole grid costs a hundredth of what a point-wise decoder takes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from refine_engine.values import Camera

IMAGE_SIDE = 64  # pixels
GRID = 40  # cells a side
HALF_SIDE = 0.55  # of the grid's cube about the origin; objects have a longest side of 1
POSE = 5  # numbers that say where the camera stood
LATENT, HIDDEN = 192, 320
SEED_CELLS, SEED_CHANNELS = 5, 48
LOOK_CELLS, LOOK_CHANNELS = 10, 32  # of the grid on which the image is looked up
Kind = Literal["image", "camera"]
KINDS: tuple[Kind, Kind] = ("image", "camera")


def weights_of(kind: Kind) -> Path:
    """Where this project's own weights are."""
    return Path(__file__).with_name(f"weights_{kind}.npz")


@dataclass(frozen=True)
class Sight:
    """What the network is given of B photos."""

    images: Tensor  # (B, 3, 64, 64) RGB in [0, 1], the square around the object
    poses: Tensor  # (B, 5), see `pose_of`
    projections: Tensor  # (B, 3, 4): homogeneous object coordinates to (u w, v w, w), the square is [-1, 1]^2


@dataclass(frozen=True)
class Code:
    """What the network makes of the photos before it decodes it."""

    latent: Tensor  # (B, 192), of the whole object
    places: Tensor | None  # (B, 32, 10, 10, 10), of what the image shows where; None: not looked up


class Reconstruction(nn.Module):
    """Sights of B photos to logits of the occupancy (B, 40, 40, 40), axes x, y, z."""

    def __init__(self, kind: Kind) -> None:
        super().__init__()
        self.kind = kind
        pose, look = (POSE, LOOK_CHANNELS) if kind == "camera" else (0, 0)
        self.near = nn.Sequential(*_down(3, 32), *_down(32, 64), *_down(64, 96))
        self.far = nn.Sequential(*_down(96, 128), nn.Conv2d(128, 48, 1), nn.ReLU(), nn.Flatten())
        self.turn = nn.Sequential(
            nn.Linear(48 * 16 + pose, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(),
            nn.Linear(HIDDEN, LATENT),
        )  # fmt: skip
        if kind == "camera":
            self.look = nn.Conv2d(96, look, 1)
        self.spread = nn.Linear(LATENT, SEED_CHANNELS * SEED_CELLS**3)
        self.grow = nn.Sequential(nn.BatchNorm3d(SEED_CHANNELS), nn.ReLU(), *_up(SEED_CHANNELS, 48))
        self.refine = nn.Sequential(
            nn.Conv3d(48 + look, 48, 3, padding=1, bias=False), nn.BatchNorm3d(48), nn.ReLU(),
            *_up(48, 32),
            nn.Conv3d(32, 8, 3, padding=1),
        )  # fmt: skip

    def forward(self, sight: Sight) -> Tensor:
        return self.decode(self.encode(sight))

    def encode(self, sight: Sight) -> Code:
        features = self.near(sight.images)  # (B, 96, 8, 8)
        if self.kind == "image":
            return Code(self.turn(self.far(features)), None)
        latent = self.turn(torch.cat([self.far(features), sight.poses], 1))
        cells = _cell_centres(LOOK_CELLS).reshape(-1, 3)
        homogeneous = torch.cat([cells, torch.ones_like(cells[:, :1])], 1)
        seen = homogeneous @ sight.projections.transpose(1, 2)  # (B, 1000, 3)
        where = (seen[..., :2] / seen[..., 2:])[:, None]
        found = F.grid_sample(self.look(features).float(), where, padding_mode="border", align_corners=False)
        return Code(latent, found.reshape(-1, LOOK_CHANNELS, LOOK_CELLS, LOOK_CELLS, LOOK_CELLS))

    def decode(self, code: Code) -> Tensor:
        """Logits (B, 40, 40, 40)."""
        seeds = self.spread(code.latent).reshape(-1, SEED_CHANNELS, SEED_CELLS, SEED_CELLS, SEED_CELLS)
        grown = self.grow(seeds)
        half = self.refine(
            grown if code.places is None else torch.cat([grown, code.places], 1)
        )  # (B, 8, 20, 20, 20): the channels are the octants of each cell
        n = GRID // 2
        octants = half.reshape(-1, 2, 2, 2, n, n, n).permute(0, 4, 1, 5, 2, 6, 3)
        logits: Tensor = octants.reshape(-1, GRID, GRID, GRID)
        return logits


def _cell_centres(cells: int) -> Tensor:
    """(cells, cells, cells, 3) in the frame of the objects."""
    middles = ((torch.arange(cells) + 0.5) / cells * 2 - 1) * HALF_SIDE
    return torch.stack(torch.meshgrid(middles, middles, middles, indexing="ij"), -1)


def pose_of(camera: Camera) -> Tensor:
    """(5,): sine and cosine of the azimuth and of its double, sine of the elevation, seen from the origin."""
    matrix = camera.world_to_camera.double()
    x, y, z = (-matrix[:3, :3].T @ matrix[:3, 3]).tolist()
    a, e = math.atan2(x, z), math.atan2(y, math.hypot(x, z))
    return torch.tensor([math.sin(a), math.cos(a), math.sin(2 * a), math.cos(2 * a), math.sin(e)])


def _down(channels: int, wider: int) -> list[nn.Module]:
    return [nn.Conv2d(channels, wider, 3, 2, 1, bias=False), nn.BatchNorm2d(wider), nn.ReLU()]


def _up(channels: int, narrower: int) -> list[nn.Module]:
    convolution = nn.ConvTranspose3d(channels, narrower, 4, 2, 1, bias=False)
    return [convolution, nn.BatchNorm3d(narrower), nn.ReLU()]


def save_weights(network: Reconstruction, path: Path) -> None:
    """float16: half the size, and a change of the occupancy far below what the training leaves open."""
    stream = BytesIO()
    arrays: dict[str, Any] = {name: _half(value) for name, value in network.state_dict().items()}
    np.savez_compressed(stream, **arrays)
    path.write_bytes(stream.getvalue())


def load_network(kind: Kind, path: Path | None = None) -> Reconstruction:
    """Ready to predict: float32, weights and statistics fixed."""
    network = Reconstruction(kind)
    with np.load(path or weights_of(kind)) as stored:
        network.load_state_dict({name: torch.from_numpy(stored[name]) for name in stored.files})
    return network.float().eval().requires_grad_(False)


def _half(value: Tensor) -> Any:
    return (value.half() if value.is_floating_point() else value).numpy()
