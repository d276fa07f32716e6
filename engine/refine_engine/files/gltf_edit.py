"""Moving the vertices of a glTF document and nothing else.

Accessors that only the moved vertices use are overwritten in place; shared ones (instances, quantised or
sparse data, overlapping bytes) stay, and a new accessor is appended at the end of the buffer. All other bytes
keep their place.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .gltf import ELEMENT_ARRAY_BUFFER, TYPES, Document, Json, set_bounds
from .gltf_geometry import TRIANGLES, Placement, local_triangles, triangle_primitives, vectors
from .tangents import carried_tangents
from .weld import Floats, Ints

CONFIDENCE = "_SYMMETRY_CONFIDENCE"
_EDITED = ("POSITION", "NORMAL", "TANGENT", CONFIDENCE)
_MAX_OVERLAP = 8  # times the buffer: what the accessors of a sane file cover in all


def move_vertices(
    document: Document,
    placements: Sequence[Placement],
    overwritable: Set[int],
    positions: Floats,
    normals: Floats,
    confidence: Floats,
) -> Document:
    """A copy of `document` with new local positions (S, 3), normals (S, 3) and the confidence attribute (S,).

    `overwritable` comes from `overwritable_accessors`. A mesh that several nodes use is given to each of them
    as its own copy, since the refined instances differ. Normals and tangents are written where the document
    has some; tangents without normals, which mean nothing, are dropped.
    """
    edited = document.copy()
    by_node: dict[int, dict[int, Placement]] = {}
    for placement in placements:
        by_node.setdefault(placement.node, {})[placement.accessor] = placement
    _separate_instances(edited, by_node)
    free = set(overwritable)
    values = {"POSITION": positions, "NORMAL": normals, CONFIDENCE: confidence[:, None]}
    for number, of_accessor in by_node.items():
        mesh = edited.item("meshes", edited.item("nodes", number)["mesh"])
        tangents = _carried(document, mesh, of_accessor, positions, normals)
        written: dict[tuple[str, int, int | None], int] = {}
        for primitive in triangle_primitives(mesh):
            attributes = primitive["attributes"]
            placement = of_accessor[attributes["POSITION"]]
            new = {name: part[placement.source] for name, part in values.items()}
            if "NORMAL" not in attributes:
                del new["NORMAL"]
                attributes.pop("TANGENT", None)
            if (was := attributes.get("TANGENT")) is not None:
                new["TANGENT"] = tangents[placement.accessor, was]
            for name, part in new.items():
                key = name, placement.accessor, was if name == "TANGENT" else None
                if key not in written:
                    was_there, bounds = attributes.get(name), name == "POSITION"
                    written[key] = _write(edited, free, was_there, part.astype("<f4"), bounds=bounds)
                attributes[name] = written[key]
    return edited


def _carried(
    document: Document, mesh: Json, of_accessor: dict[int, Placement], positions: Floats, normals: Floats
) -> dict[tuple[int, int], Floats]:
    """New tangents (N, 4) by the accessors of POSITION and TANGENT that primitives of one mesh share."""
    faces: dict[tuple[int, int], list[Ints]] = {}
    for primitive in triangle_primitives(mesh):
        attributes = primitive["attributes"]
        if {"NORMAL", "TANGENT"} <= attributes.keys():
            shared = attributes["POSITION"], attributes["TANGENT"]
            faces.setdefault(shared, []).append(local_triangles(document, primitive))
    return {
        (place, tangent): carried_tangents(
            vectors(document, {"TANGENT": tangent}, "TANGENT", 4, len(of_accessor[place].positions)),
            of_accessor[place].positions,
            positions[of_accessor[place].source],
            np.concatenate(parts),
            normals[of_accessor[place].source],
        )
        for (place, tangent), parts in faces.items()
    }


def keep_triangles(document: Document, placements: Sequence[Placement], kept: NDArray[np.bool_]) -> None:
    """Leave out the triangles that are not in `kept` (F,), in the order in which `read_scene` numbers them.

    Only the indices of a primitive change; one that would lose all its triangles keeps them, since glTF has
    no empty primitive. Call it on what `move_vertices` made.
    """
    start = 0
    for number in sorted({placement.node for placement in placements}):
        for primitive in triangle_primitives(document.item("meshes", document.item("nodes", number)["mesh"])):
            triangles = local_triangles(document, primitive)
            still = kept[start : start + len(triangles)]
            start += len(triangles)
            if still.all() or not still.any():
                continue
            corners = triangles[still].reshape(-1, 1).astype("<u4")
            primitive["indices"] = document.append(corners, target=ELEMENT_ARRAY_BUFFER)
            primitive["mode"] = TRIANGLES


def overwritable_accessors(document: Document, nodes: Set[int]) -> frozenset[int]:
    """Accessors that nothing but the edited attributes of these nodes' meshes refers to, and whose bytes no
    other accessor covers. Raises MeshInvalid for an accessor of the document that leaves its buffer."""
    ours = {document.item("nodes", node)["mesh"] for node in nodes}
    others = {node.get("mesh") for n, node in enumerate(document.json["nodes"]) if n not in nodes}
    meshes = [document.item("meshes", n) for n in sorted(ours - others)]
    edited = Counter(
        primitive["attributes"][name]
        for mesh in meshes
        for primitive in triangle_primitives(mesh)
        for name in _EDITED
        if name in primitive["attributes"]
    )
    every = Counter(_references(document))
    stored = [a for a in document.json.get("accessors", []) if "bufferView" in a]
    once, twice = (np.zeros(len(document.binary), np.uint8) for _ in range(2))
    covered = 0
    for accessor in stored:
        lane = document.element_bytes(accessor, once)
        covered += lane.size
        if covered > _MAX_OVERLAP * len(once):
            return frozenset()
        document.element_bytes(accessor, twice)[lane > 0] = 1
        lane[:] = 1
    return frozenset(
        number
        for number in edited
        if edited[number] == every[number]
        and _is_plain(document.item("accessors", number))
        and not document.element_bytes(document.item("accessors", number), twice).any()
    )


def _references(document: Document) -> Iterator[int]:
    """Every reference to an accessor in the document."""
    for mesh in document.json.get("meshes", []):
        for primitive in mesh.get("primitives", []):
            yield from primitive.get("attributes", {}).values()
            for target in primitive.get("targets", []):
                yield from target.values()
            if "indices" in primitive:
                yield primitive["indices"]
    for skin in document.json.get("skins", []):
        if "inverseBindMatrices" in skin:
            yield skin["inverseBindMatrices"]
    for animation in document.json.get("animations", []):
        for sampler in animation.get("samplers", []):
            yield sampler["input"]
            yield sampler["output"]


def _separate_instances(document: Document, nodes: Iterable[int]) -> None:
    """Give every one of the nodes a mesh that no other node has."""
    placed = set(nodes)
    others = (node for n, node in enumerate(document.json["nodes"]) if n not in placed)
    taken = {node["mesh"] for node in others if "mesh" in node}  # of other scenes, invisible or flattened
    for number in placed:
        node = document.item("nodes", number)
        if node["mesh"] in taken:
            document.json["meshes"].append(copy.deepcopy(document.item("meshes", node["mesh"])))
            node["mesh"] = len(document.json["meshes"]) - 1
        taken.add(node["mesh"])


def _write(
    document: Document, free: set[int], accessor: int | None, values: NDArray[Any], *, bounds: bool
) -> int:
    """Write elements over `accessor` if it is free, else append them; returns where they are."""
    if accessor is None or accessor not in free:
        return document.append(values, bounds=bounds)
    free.discard(accessor)
    entry = document.item("accessors", accessor)
    if (entry["type"], entry["count"]) != (TYPES[values.shape[1]], len(values)):
        return document.append(values, bounds=bounds)
    document.elements(entry)[:] = values
    if bounds or "min" in entry or "max" in entry:
        set_bounds(entry, values)
    return accessor


def _is_plain(accessor: Json) -> bool:
    return accessor.get("componentType") == 5126 and "bufferView" in accessor and "sparse" not in accessor
