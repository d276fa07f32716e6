"""What the faces alone determine: edges, neighbours, pairs of faces. Built once, before the loop."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .sparse import SparseMatrix


@dataclass(frozen=True)
class Topology:
    """Index tensors of a triangle mesh.

    A hinge is two faces that share an edge: corners (start, end, opposite in one face, opposite in the
    other); an edge of three or more faces gives a hinge for each pair of consecutive ones.
    """

    faces: Tensor  # (F, 3) int64
    edges: Tensor  # (E, 2) int64, each once, smaller index first
    adjacency: SparseMatrix  # (V, V), sums over the neighbours
    own_and_adjacency: SparseMatrix  # (V, 2V), row 2v of the factor is v's own, row 2v + 1 for its neighbours
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
        adjacency = SparseMatrix.of(centre, neighbour, (vertex_count, vertex_count))
        vertex = torch.arange(vertex_count, device=faces.device)
        own_and_adjacency = SparseMatrix.of(
            torch.cat([vertex, centre]),
            torch.cat([2 * vertex, 2 * neighbour + 1]),
            (vertex_count, 2 * vertex_count),
        )
        count = torch.bincount(centre, minlength=vertex_count)
        degree = count.clamp_min(1).to(torch.float32)[:, None]
        return Topology(faces, edges, adjacency, own_and_adjacency, degree, hinges)


def neighbour_mean(x: Tensor, topology: Topology) -> Tensor:
    """Mean over the neighbours of v, zero for a vertex without any: (V, C) -> (V, C)."""
    return (topology.adjacency @ x) / topology.degree
