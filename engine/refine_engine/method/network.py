"""The network that is fitted to one instance: silhouette encoder and graph refiner (paper, section 3.2)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .topology import Topology

WIDTH = 128  # channels of the graph convolutions
DEPTH = 8  # graph convolutions


class ResidualBlock(nn.Module):
    """ResNet basic block with the statistics of the batch, which is one image: instance normalisation."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride, 1, bias=False)
        self.norm1 = nn.BatchNorm2d(channels, track_running_stats=False)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(channels, track_running_stats=False)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels:
            self.shortcut = nn.Sequential(
                nn.Conv2d(channels_in, channels, 1, stride, bias=False),
                nn.BatchNorm2d(channels, track_running_stats=False),
            )

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm1(self.conv1(x)))
        y = self.norm2(self.conv2(y))
        summed: Tensor = y + self.shortcut(x)
        return F.relu(summed)


class Encoder(nn.Module):
    """Stem and first two stages of ResNet-18 on the silhouette."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(1, 64, 7, 2, 3, bias=False),
            nn.BatchNorm2d(64, track_running_stats=False),
            nn.ReLU(),
            nn.MaxPool2d(3, 2, 1),
        )
        self.stage1 = nn.Sequential(ResidualBlock(64, 64, 1), ResidualBlock(64, 64, 1))
        self.stage2 = nn.Sequential(ResidualBlock(64, 128, 2), ResidualBlock(128, 128, 1))

    def forward(self, silhouette: Tensor) -> tuple[Tensor, Tensor]:
        """(1, 1, N, N) -> feature maps (1, 64, N/4, N/4) and (1, 128, N/8, N/8)."""
        fine = self.stage1(self.stem(silhouette))
        return fine, self.stage2(fine)

    def store_channels_last(self) -> None:
        """The weights in the order of memory that is fastest on CPUs; the feature maps follow them."""
        for parameter in self.parameters():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)


class GraphConv(nn.Module):
    """w0 x_v + b0 + sum over the neighbours u of (w1 x_u + b1), as one matrix product and one gather."""

    def __init__(self, channels_in: int, channels: int) -> None:
        super().__init__()
        self.own_and_neighbour = nn.Linear(channels_in, 2 * channels)

    def forward(self, x: Tensor, topology: Topology) -> Tensor:
        both: Tensor = self.own_and_neighbour(x)  # (V, 2C): what v keeps, what it gives to each neighbour
        return topology.own_and_adjacency @ both.view(2 * len(x), -1)


class Refiner(nn.Module):
    """Vertex features -> displacement (V, 3) and symmetry confidence (V,)."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.bottleneck = nn.Linear(64 + 128, WIDTH)
        self.convs = nn.ModuleList([GraphConv(WIDTH + 3 if i == 0 else WIDTH, WIDTH) for i in range(DEPTH)])
        self.displacement = nn.Linear(WIDTH, 3)
        self.confidence = nn.Sequential(
            nn.Linear(WIDTH, 32), nn.ReLU(), nn.Linear(32, 16), nn.ReLU(), nn.Linear(16, 1), nn.Sigmoid()
        )

    def features(self, silhouette: Tensor, grid: Tensor) -> Tensor:
        """What the encoder sees at each vertex: (V, 192).

        silhouette (1, 1, N, N); grid (1, 1, V, 2) where the camera sees each vertex, -1 ... 1 over the image.
        """
        maps = self.encoder(silhouette)
        seen = [F.grid_sample(m, grid, align_corners=False, padding_mode="border")[0, :, 0].T for m in maps]
        return torch.cat(seen, 1)

    def forward(self, features: Tensor, vertices: Tensor, topology: Topology) -> tuple[Tensor, Tensor]:
        """(V, 192) and normalised (V, 3) -> displacement (V, 3), symmetry confidence (V,) in [0, 1]."""
        x = torch.cat([self.bottleneck(features), vertices], 1)
        for conv in self.convs:
            x = F.relu_(conv(x, topology))
        confidence: Tensor = self.confidence(x)
        return self.displacement(x), confidence[:, 0]


def make_network(mean_degree: float, seed: int, device: torch.device) -> Refiner:
    """A network with random weights of its own generator; torch's is left alone."""
    with torch.device("meta"):  # `initialise` draws all weights
        network = Refiner()
    network.to_empty(device="cpu")
    initialise(network, mean_degree, torch.Generator().manual_seed(seed))
    if device.type == "cpu":
        network.encoder.store_channels_last()
    return network.to(device)


def initialise(network: Refiner, mean_degree: float, generator: torch.Generator) -> None:
    """Random weights that keep the variance of activations (He et al. 2015), every draw from one generator.

    A graph convolution adds 1 + degree inputs, and neighbours are alike: their sum is about `degree` times
    one of them. The displacement head starts at zero, so that the first iterate is the coarse mesh.
    """
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                fan_in = module.weight[0].numel()
                module.weight.normal_(0, math.sqrt(2 / fan_in), generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.BatchNorm2d):
                module.weight.fill_(1)
                module.bias.zero_()
        for module in network.modules():
            if isinstance(module, GraphConv):
                own, neighbour = module.own_and_neighbour.weight.chunk(2, 0)
                own.mul_(math.sqrt(0.5))
                neighbour.mul_(math.sqrt(0.5) / mean_degree)
        network.displacement.weight.zero_()
