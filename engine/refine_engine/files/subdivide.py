"""Splitting the long edges of a glTF document's triangles, so that a coarse mesh has vertices that can move.

An edge is split in the middle wherever it occurs, by its length in the world: copies of a vertex at a seam
have one position, so both sides of the seam are split alike. All attributes are interpolated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .gltf import ELEMENT_ARRAY_BUFFER, Document, Json
from .gltf_geometry import TRIANGLES, Placement, SceneGeometry, local_triangles, triangle_primitives
from .weld import Floats, Ints

LONGEST_EDGE = 0.06  # longest sides of the scene's box: a ball of 1,500 vertices has edges of 0.05
MOST_TRIANGLES = 20_000  # a round that would make more is not begun


def subdivided(document: Document, scene: SceneGeometry) -> Document | None:
    """A copy of `document` whose triangles in `scene` have no edge longer than LONGEST_EDGE.

    None: there is none to split. Skinned meshes keep theirs, and so do all where there would be more than
    MOST_TRIANGLES.
    """
    used = scene.world_positions()[np.unique(scene.faces)]
    longest = LONGEST_EDGE * float(np.ptp(used, axis=0).max())
    finer = document.copy()
    parts = list(_parts(finer, scene))
    split = False
    while True:
        marked = [part.long_edges(longest) for part in parts]
        triangles = sum(len(part.triangles) for part in parts) + 2 * sum(map(len, marked))
        if not any(map(len, marked)) or triangles > MOST_TRIANGLES:
            break
        for part, edges in zip(parts, marked, strict=True):
            part.split(edges)
        split = True
    for part in parts:
        part.write(finer)
    return finer if split else None


@dataclass
class _Part:
    """The triangles of one primitive, and the attributes of the vertices that they use."""

    primitive: Json
    placements: tuple[Placement, ...]  # of the nodes that show it
    triangles: Ints  # (T, 3)
    values: dict[
        tuple[int, str], Floats
    ]  # (N, C) by the number of the morph target, -1 of none, and the name
    is_split: bool = False

    def long_edges(self, longest: float) -> Ints:
        """(E, 2) smaller index first, each once."""
        edges = np.unique(np.sort(self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        length = np.zeros(len(edges))
        for placement in self.placements:
            world = placement.to_world(self.values[-1, "POSITION"])
            np.maximum(length, np.linalg.norm(world[edges[:, 0]] - world[edges[:, 1]], axis=1), out=length)
        return edges[length > longest]

    def split(self, edges: Ints) -> None:
        """Put a vertex in the middle of each of the edges (E, 2)."""
        if not len(edges):
            return
        self.is_split = True
        count = len(self.values[-1, "POSITION"])
        for name, values in self.values.items():
            middle = ((values[edges[:, 0]] + values[edges[:, 1]]) / 2).astype(np.float32)
            self.values[name] = np.concatenate([values, middle])
        key = edges[:, 0] * count + edges[:, 1]
        sides = np.sort(np.stack([self.triangles, np.roll(self.triangles, -1, 1)], 2), axis=2)
        at = np.searchsorted(key, sides[..., 0] * count + sides[..., 1]).clip(max=len(key) - 1)
        is_split = key[at] == sides[..., 0] * count + sides[..., 1]
        self.triangles = _cut(self.triangles, np.where(is_split, count + at, -1))

    def write(self, document: Document) -> None:
        """Make the primitive what it has become; one that was not split stays as it is."""
        if not self.is_split:
            return
        for (target, name), values in self.values.items():
            owner = self.primitive["attributes"] if target < 0 else self.primitive["targets"][target]
            owner[name] = document.append(values.astype("<f4"), bounds=name == "POSITION")
        corners = self.triangles.reshape(-1, 1).astype("<u4")
        self.primitive["indices"] = document.append(corners, target=ELEMENT_ARRAY_BUFFER)
        self.primitive["mode"] = TRIANGLES


def _parts(document: Document, scene: SceneGeometry) -> Iterator[_Part]:
    by_mesh: dict[int, list[Placement]] = {}
    for placement in scene.placements:
        by_mesh.setdefault(document.item("nodes", placement.node)["mesh"], []).append(placement)
    for number, placements in by_mesh.items():
        for primitive in triangle_primitives(document.item("meshes", number)):
            attributes = primitive["attributes"]
            if "JOINTS_0" in attributes:  # which joints move a vertex cannot be interpolated
                continue
            shown = tuple(p for p in placements if p.accessor == attributes["POSITION"])
            triangles = local_triangles(document, primitive)
            used = np.unique(triangles)
            number_of = np.zeros(int(used.max(initial=-1)) + 1, np.int64)
            number_of[used] = np.arange(len(used))
            values = {
                (target, name): document.read(accessor)[used].astype(np.float64)
                for target, owner in enumerate([attributes, *primitive.get("targets", [])], -1)
                for name, accessor in owner.items()
            }
            yield _Part(primitive, shown, number_of[triangles], values)


def _cut(triangles: Ints, middles: Ints) -> Ints:
    """The triangles (T, 3) with new vertices `middles` (T, 3) on the side after each corner; -1: none."""
    split = middles >= 0
    pieces = [triangles[~split.any(1)]]
    for first in range(3):  # turned so that this corner comes first
        (a, b, c), (ab, bc, ca) = (np.roll(rows, -first, 1).T for rows in (triangles, middles))
        has_ab, has_bc, has_ca = np.roll(split, -first, 1).T
        one, two = has_ab & ~has_bc & ~has_ca, has_ab & has_bc & ~has_ca
        pieces += [np.stack(corners, 1)[one] for corners in ((a, ab, c), (ab, b, c))]
        pieces += [np.stack(corners, 1)[two] for corners in ((ab, b, bc), (a, ab, bc), (a, bc, c))]
    (a, b, c), (ab, bc, ca) = triangles.T, middles.T
    pieces += [
        np.stack(corners, 1)[split.all(1)]
        for corners in ((a, ab, ca), (ab, b, bc), (bc, c, ca), (ab, bc, ca))
    ]
    return np.concatenate(pieces)
