"""Index tensors of meshes small enough to draw."""

import pytest
import torch

from refine_engine.method.topology import Topology, neighbour_mean


def topology(*faces: list[int], vertices: int) -> Topology:
    return Topology.of(torch.tensor(faces), vertices)


def neighbours(t: Topology) -> list[list[int]]:
    bags = t.adjacency.rows
    ends = [*bags.offsets.tolist()[1:], len(bags.columns)]
    return [sorted(bags.columns[a:b].tolist()) for a, b in zip(bags.offsets.tolist(), ends, strict=True)]


def hinges(t: Topology) -> list[tuple[int, int, list[int]]]:
    """(start, end, both opposite corners), sorted."""
    return sorted((a, b, sorted(rest)) for a, b, *rest in t.hinges.tolist())


#  3---2
#  | / |
#  0---1
SQUARE = [[0, 1, 2], [0, 2, 3]]


def test_square() -> None:
    t = topology(*SQUARE, vertices=4)
    assert t.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert neighbours(t) == [[1, 2, 3], [0, 2], [0, 1, 3], [0, 2]]
    assert t.degree.tolist() == [[3], [2], [3], [2]]
    assert hinges(t) == [(0, 2, [1, 3])]  # the four outer edges have one face each


@pytest.mark.parametrize("faces", [[[0, 1, 2], [0, 3, 2]], [[2, 1, 0], [0, 2, 3]], [[1, 2, 0], [3, 0, 2]]])
def test_winding_and_first_corner_do_not_matter(faces: list[list[int]]) -> None:
    t, expected = topology(*faces, vertices=4), topology(*SQUARE, vertices=4)
    assert torch.equal(t.edges, expected.edges)
    assert neighbours(t) == neighbours(expected)
    assert hinges(t) == hinges(expected)


def test_tetrahedron_is_closed() -> None:
    """Every edge is a hinge, with the two vertices that are not on it."""
    t = topology([0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2], vertices=4)
    assert neighbours(t) == [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]
    assert hinges(t) == [
        (0, 1, [2, 3]), (0, 2, [1, 3]), (0, 3, [1, 2]), (1, 2, [0, 3]), (1, 3, [0, 2]), (2, 3, [0, 1]),
    ]  # fmt: skip


def test_three_faces_on_one_edge() -> None:
    """A book of three pages 2, 3, 4 on the spine 0-1: a hinge for consecutive pages."""
    t = topology([0, 1, 2], [0, 1, 3], [1, 0, 4], vertices=5)
    assert t.edges.tolist() == [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [1, 3], [1, 4]]
    spine = hinges(t)
    assert len(spine) == 2
    assert all((start, end) == (0, 1) for start, end, _ in spine)
    assert {page for _, _, pages in spine for page in pages} == {2, 3, 4}


def test_two_pieces_and_vertices_without_a_face() -> None:
    """Triangles 1-2-3 and 5-6-7; 0 at the start, 4 in the middle and 8 at the end are alone."""
    t = topology([1, 2, 3], [5, 6, 7], vertices=9)
    assert neighbours(t) == [[], [2, 3], [1, 3], [1, 2], [], [6, 7], [5, 7], [5, 6], []]
    assert t.degree[:, 0].tolist() == [1, 2, 2, 2, 1, 2, 2, 2, 1]
    values = torch.arange(9.0)[:, None]
    assert (t.adjacency @ values)[:, 0].tolist() == [0, 5, 4, 3, 0, 13, 12, 11, 0]
    assert neighbour_mean(values, t)[:, 0].tolist() == [0, 2.5, 2, 1.5, 0, 6.5, 6, 5.5, 0]


def test_a_face_stored_twice_has_no_fold_with_itself() -> None:
    t = topology([0, 1, 2], [2, 1, 0], vertices=3)
    assert t.edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert hinges(t) == []


def test_a_face_with_a_repeated_corner_adds_nothing() -> None:
    """The square, with a face 0-2-2 between its two on the diagonal, and 0-0-3 and 1-1-1."""
    t = topology([0, 1, 2], [0, 2, 2], [0, 2, 3], [0, 0, 3], [1, 1, 1], vertices=4)
    assert t.edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert hinges(t) == [(0, 2, [1, 3])]


def test_neighbour_sums_are_products_with_the_adjacency_matrix() -> None:
    """Of one factor (V, C), and of a factor (2V, C) with what a vertex keeps and what it gives in turn."""
    random = torch.Generator().manual_seed(0)
    t = Topology.of(torch.randint(0, 50, (60, 3), generator=random), 52)
    dense = torch.zeros(52, 52)
    for a, b in t.edges.tolist():
        dense[a, b] = dense[b, a] = 1
    kept, given = torch.randn(2, 52, 7, generator=random)
    torch.testing.assert_close(t.adjacency @ given, dense @ given)
    both = torch.stack([kept, given], 1).reshape(104, 7)
    torch.testing.assert_close(t.own_and_adjacency @ both, kept + dense @ given)
