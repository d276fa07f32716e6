"""What the faces alone determine: edges, neighbours, pairs of faces. Built once, before the loop."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class Topology:
    """Index tensors of a triangle mesh.

    The neighbours of vertex v are `neighbours[offsets[v] : offsets[v + 1]]`. A hinge is two faces that share
    an edge: corners (start, end, opposite in one face, opposite in the other); an edge of three or more faces
    gives a hinge for each pair of consecutive ones.
    """

    faces: Tensor  # (F, 3) int64
    edges: Tensor  # (E, 2) int64, each once, smaller index first
    neighbours: Tensor  # (2E,) int64
    offsets: Tensor  # (V,) int64, where each vertex's neighbours begin
    degree: Tensor  # (V, 1) float32, number of neighbours, at least 1
    hinges: Tensor  # (P, 4) int64

    @staticmethod
    def of(faces: Tensor, vertex_count: int) -> Topology:
        start = faces[:, [0, 1, 2]].T.reshape(-1)
        end = faces[:, [1, 2, 0]].T.reshape(-1)
        opposite = faces[:, [2, 0, 1]].T.reshape(-1)
        low, high = torch.minimum(start, end), torch.maximum(start, end)
        proper = (low != high) & (opposite != low) & (opposite != high)  # a repeated corner: not a face
        low, high, opposite = low[proper], high[proper], opposite[proper]
        key = low * vertex_count + high
        order = key.argsort(stable=True)
        low, high, opposite, key = low[order], high[order], opposite[order], key[order]

        first = torch.ones_like(key, dtype=torch.bool)
        first[1:] = key[1:] != key[:-1]
        edges = torch.stack([low[first], high[first]], 1)
        second = (~first).nonzero()[:, 0]  # each with its predecessor on the same edge
        hinges = torch.stack([low[second], high[second], opposite[second - 1], opposite[second]], 1)
        hinges = hinges[hinges[:, 2] != hinges[:, 3]]  # the same face twice has no fold

        centre = torch.cat([edges[:, 0], edges[:, 1]])
        neighbour = torch.cat([edges[:, 1], edges[:, 0]])
        order = centre.argsort(stable=True)
        count = torch.bincount(centre, minlength=vertex_count)
        offsets = count.cumsum(0) - count
        degree = count.clamp_min(1).to(torch.float32)[:, None]
        return Topology(faces, edges, neighbour[order], offsets, degree, hinges)


class _NeighbourSum(torch.autograd.Function):
    """The adjacency matrix is symmetric, so the gradient is the same sum: a gather, never a scatter."""

    @staticmethod
    def forward(ctx: object, x: Tensor, topology: Topology) -> Tensor:
        ctx.topology = topology  # type: ignore[attr-defined]
        return F.embedding_bag(topology.neighbours, x.contiguous(), topology.offsets, mode="sum")

    @staticmethod
    def backward(ctx: object, *grads: Tensor) -> tuple[Tensor, None]:
        topology: Topology = ctx.topology  # type: ignore[attr-defined]
        return F.embedding_bag(topology.neighbours, grads[0].contiguous(), topology.offsets, mode="sum"), None


def neighbour_sum(x: Tensor, topology: Topology) -> Tensor:
    """sum over the neighbours u of v of x_u: (V, C) -> (V, C)."""
    result: Tensor = _NeighbourSum.apply(x, topology)
    return result


def neighbour_mean(x: Tensor, topology: Topology) -> Tensor:
    """Mean over the neighbours of v, zero for a vertex without any: (V, C) -> (V, C)."""
    return neighbour_sum(x, topology) / topology.degree
