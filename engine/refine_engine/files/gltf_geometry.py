"""The triangles of a glTF document's default scene in world space, and where each vertex came from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatUnsupported, MeshInvalid
from .gltf import Document, Json, natural
from .limits import MeshLimits
from .weld import Floats, Ints, unit

TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6
_MAX_PARTS = 20_000  # nodes, and primitives as nodes place them: each costs time however few triangles it has
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)  # of an affine transform
_MAX_CONDITION = 1e8  # of a node's transform: beyond it world positions cannot be taken back


@dataclass(frozen=True)
class Placement:
    """One POSITION accessor as one node places it: N source vertices, numbered from `start`."""

    node: int
    accessor: int
    start: int
    positions: Floats  # (N, 3) local
    normals: Floats  # (N, 3) local, zero where the file gives none
    matrix: Floats  # local to world: (4, 4), or (N, 4, 4) for a skinned mesh

    @property
    def source(self) -> slice:
        return slice(self.start, self.start + len(self.positions))

    def to_world(self, points: Floats) -> Floats:
        return transform(self.matrix, points)

    def moved(self, world: Floats, vertex_of: Ints) -> Floats:
        """Local positions (N, 3) after moving to `world` (N, 3); `vertex_of` (N,) are the welded vertices.

        What moves is a difference, so that an unmoved vertex keeps its bits. The copies of one vertex start
        from one position, so that they end at one to the last bit (the skinned ones only if they were bound
        alike).
        """
        start = self.positions
        if self.matrix.ndim == 2:
            _, first, copy = np.unique(vertex_of, return_index=True, return_inverse=True)
            start = start[first][copy]
        return start + transform(_linear(_inverse(self.matrix)), world - self.to_world(start))

    def normals_to_world(self, normals: Floats) -> Floats:
        return unit(transform(_linear(_inverse(self.matrix).swapaxes(-1, -2)), normals), fallback=np.zeros(3))

    def normals_to_local(self, normals: Floats) -> Floats:
        return unit(transform(_linear(self.matrix.swapaxes(-1, -2)), normals), fallback=normals)


@dataclass(frozen=True)
class SceneGeometry:
    """S source vertices of all placements, and the triangles between them."""

    placements: tuple[Placement, ...]
    faces: Ints  # (F, 3) wound as they appear in world space
    warnings: tuple[str, ...]

    def world_positions(self) -> Floats:
        return np.concatenate([placement.to_world(placement.positions) for placement in self.placements])

    def world_normals(self) -> Floats:
        return np.concatenate(
            [placement.normals_to_world(placement.normals) for placement in self.placements]
        )


def triangle_primitives(mesh: Json) -> Iterator[Json]:
    """The primitives of a mesh that have triangles; points and lines are left alone."""
    for primitive in mesh.get("primitives", []):
        has_triangles = primitive.get("mode", TRIANGLES) in (TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN)
        if has_triangles and "POSITION" in primitive.get("attributes", {}):
            yield primitive


def read_scene(document: Document, limits: MeshLimits) -> SceneGeometry:
    """All triangles of the default scene. Raises MeshInvalid if there are none or they are broken."""
    matrices, hidden = _world_matrices(document)
    meshes = [node for node in sorted(matrices) if "mesh" in document.item("nodes", node)]
    placed = [n for n in meshes if n not in hidden and not _is_flat(document.item("nodes", n), matrices[n])]
    if meshes and not placed:
        raise MeshInvalid(
            f"expected an invertible transform of node {meshes[0]}, got one that flattens or is "
            "not finite, or an invisible node"
        )
    _check_size(document, placed, limits)
    placements: dict[tuple[int, int], Placement] = {}
    faces: list[Ints] = []
    start, others = 0, 0
    for number in placed:
        node = document.item("nodes", number)
        mesh = document.item("meshes", node["mesh"])
        _refuse_morphed(node, mesh)
        primitives = list(triangle_primitives(mesh))
        others += len(mesh.get("primitives", [])) - len(primitives)
        for primitive in primitives:
            accessor = primitive["attributes"]["POSITION"]
            if (number, accessor) not in placements:
                placement = _place(document, number, primitive, start, matrices)
                placements[number, accessor] = placement
                start += len(placement.positions)
            faces.append(_world_faces(document, primitive, placements[number, accessor]))
    if not sum(map(len, faces)):
        raise MeshInvalid(
            "expected triangles in the default scene, got "
            + ("only points or lines" if others else "a scene without a mesh")
        )
    warnings = [f"{others} primitives of points or lines were left as they are"] if others else []
    if odd := len(meshes) - len(placed):
        warnings.append(
            f"{odd} nodes that are invisible or flattened by their transform were left as they are"
        )
    return SceneGeometry(tuple(placements.values()), np.concatenate(faces), tuple(warnings))


def transform(matrix: Floats, points: Floats) -> Floats:
    """Apply (4, 4) or (N, 4, 4) to points (N, 3). Written out per coordinate so that equal points stay equal
    to the last bit, which a matrix product does not promise."""
    x, y, z = points[:, 0:1], points[:, 1:2], points[:, 2:3]
    moved: Floats = (
        x * matrix[..., :3, 0] + y * matrix[..., :3, 1] + z * matrix[..., :3, 2] + matrix[..., :3, 3]
    )
    return moved


def _inverse(matrix: Floats) -> Floats:
    return np.linalg.inv(matrix).astype(np.float64)


def _linear(matrix: Floats) -> Floats:
    linear = np.zeros_like(matrix)
    linear[..., :3, :3] = matrix[..., :3, :3]
    return linear


def _world_matrices(document: Document) -> tuple[dict[int, Floats], set[int]]:
    """The world matrix of every node of the default scene, which must be a tree, and the invisible nodes."""
    world: dict[int, Floats] = {}
    hidden: set[int] = set()
    stack = [(root, np.eye(4), False) for root in _roots(document)]
    while stack:
        number, parent, below_hidden = stack.pop()
        node = document.item("nodes", number)
        if number in world:
            raise MeshInvalid(
                f"malformed glTF: expected a tree of nodes, node {number} is reached twice (a cycle?)"
            )
        if len(world) == _MAX_PARTS:
            raise MeshInvalid(f"expected at most {_MAX_PARTS} nodes in the scene; join the meshes first")
        with np.errstate(over="ignore", invalid="ignore"):
            world[number] = parent @ _local_matrix(node)
        visible = node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True)
        if below_hidden or not visible:
            hidden.add(number)
        stack.extend((child, world[number], number in hidden) for child in node.get("children", []))
    return world, hidden


def _is_flat(node: Json, matrix: Floats) -> bool:
    """The node's own matrix places its mesh, and what it moves cannot be taken back."""
    return "skin" not in node and not _is_invertible(matrix)


def _is_invertible(matrix: Floats) -> bool:
    with np.errstate(all="ignore"):
        finite = np.isfinite(matrix).all()
        return bool(finite and (np.linalg.cond(matrix[..., :3, :3]) < _MAX_CONDITION).all())


def _roots(document: Document) -> list[int]:
    if document.json.get("scenes"):
        return list(document.item("scenes", document.json.get("scene", 0)).get("nodes", []))
    nodes = document.json.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [number for number in range(len(nodes)) if number not in children]


def _local_matrix(node: Json) -> Floats:
    if "matrix" in node:
        return _affine(np.array(node["matrix"], np.float64).reshape(4, 4).T)
    matrix = np.eye(4)
    rotation = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64).reshape(4)
    x, y, z, w = unit(rotation, fallback=np.array([0.0, 0.0, 0.0, 1.0]))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] = np.array(rows) * np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    return matrix


def _affine(matrix: Floats) -> Floats:
    """The matrix or matrices (..., 4, 4), with exactly the last row that the standard asks for."""
    if not np.allclose(matrix[..., 3, :], _LAST_ROW, atol=1e-3):
        raise MeshInvalid("malformed glTF: expected a matrix with the last row 0 0 0 1, got another one")
    matrix[..., 3, :] = _LAST_ROW
    return matrix


def _check_size(document: Document, nodes: list[int], limits: MeshLimits) -> None:
    """Refuse by the counts that the accessors announce, before anything is read."""
    vertices, faces, primitives = 0, 0, 0
    for number in nodes:
        seen: set[int] = set()
        for primitive in triangle_primitives(document.item("meshes", document.item("nodes", number)["mesh"])):
            accessor = primitive["attributes"]["POSITION"]
            count = natural(document.item("accessors", accessor), "count")
            vertices += 0 if accessor in seen else count
            seen.add(accessor)
            corners = count
            if "indices" in primitive:
                corners = natural(document.item("accessors", primitive["indices"]), "count")
            faces += corners // 3 if primitive.get("mode", TRIANGLES) == TRIANGLES else max(corners - 2, 0)
            primitives += 1
        limits.check_source(vertices, faces)
        if primitives > _MAX_PARTS:
            raise MeshInvalid(f"expected at most {_MAX_PARTS} primitives in the scene; join the meshes first")


def _refuse_morphed(node: Json, mesh: Json) -> None:
    if any(node.get("weights") or mesh.get("weights") or []):
        raise FormatUnsupported(
            "morph targets with weights other than 0 are not supported; apply them to the mesh first"
        )


def _place(
    document: Document, number: int, primitive: Json, start: int, matrices: dict[int, Floats]
) -> Placement:
    attributes, node = primitive["attributes"], document.item("nodes", number)
    positions = vectors(document, attributes, "POSITION", 3)
    if not np.isfinite(positions).all():
        bad = int((~np.isfinite(positions)).any(1).sum())
        raise MeshInvalid(
            f"expected finite vertex positions, got NaN or infinity in {bad} of {len(positions)}"
        )
    normals = np.zeros_like(positions)
    if "NORMAL" in attributes:
        normals = vectors(document, attributes, "NORMAL", 3, len(positions))
        normals = np.where(np.isfinite(normals).all(1, keepdims=True), normals, 0.0)
    if "TANGENT" in attributes:  # now, not after the optimisation
        vectors(document, attributes, "TANGENT", 4, len(positions))
    if "skin" in node:
        matrix = _skin_matrices(document, node, attributes, len(positions), matrices)
    else:
        matrix = matrices[number]
    if not _is_invertible(matrix):
        raise MeshInvalid(
            f"expected an invertible transform of node {number}, got one that flattens or is not finite"
        )
    return Placement(number, attributes["POSITION"], start, positions, normals, matrix)


def vectors(
    document: Document, attributes: Json, name: str, components: int, count: int | None = None
) -> NDArray[np.float64]:
    """The elements (N, components) of an attribute, `count` of them. Raises MeshInvalid."""
    announced = document.item("accessors", attributes.get(name)).get("count")
    if count is not None and announced != count:
        raise MeshInvalid(f"malformed glTF: {name} has {announced!r:.20} elements, POSITION has {count}")
    values = document.read(attributes[name])
    if values.shape[1] != components:
        raise MeshInvalid(
            f"malformed glTF: expected {components} components in {name}, got {values.shape[1]}"
        )
    return values.astype(np.float64)


def local_triangles(document: Document, primitive: Json) -> Ints:
    """The triangles (F, 3) of a primitive, indices into its own vertices. Raises MeshInvalid."""
    count = document.item("accessors", primitive["attributes"]["POSITION"])["count"]
    if "indices" in primitive:
        corners = document.read(primitive["indices"])
        if corners.shape[1] != 1 or corners.dtype.kind != "u":
            raise MeshInvalid("malformed glTF: expected indices of unsigned integers")
        indices = corners[:, 0].astype(np.int64)
    else:
        indices = np.arange(count)
    if len(indices) and indices.max() >= count:
        raise MeshInvalid(f"expected face indices from 0 to {count - 1}, got {indices.max()}")
    return _triangles(indices, primitive.get("mode", TRIANGLES))


def _world_faces(document: Document, primitive: Json, placement: Placement) -> Ints:
    faces = local_triangles(document, primitive)
    if np.linalg.det(placement.matrix.reshape(-1, 4, 4)[0, :3, :3]) < 0:
        faces = faces[
            :, ::-1
        ]  # a mirrored node turns its triangles around, so that their front stays outside
    return faces + placement.start


def _triangles(indices: Ints, mode: int) -> Ints:
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.empty((0, 3), np.int64)
    if mode == TRIANGLE_FAN:
        return np.stack([indices[1:-1], indices[2:], np.full(len(indices) - 2, indices[0])], 1)
    strip = np.stack([indices[:-2], indices[1:-1], indices[2:]], 1)
    strip[1::2] = strip[1::2, [0, 2, 1]]
    return strip


def _skin_matrices(
    document: Document, node: Json, attributes: Json, count: int, matrices: dict[int, Floats]
) -> Floats:
    """Local to world (N, 4, 4) of a skinned mesh as the scene poses it: its joints place it, not its own
    node."""
    skin = document.item("skins", node["skin"])
    joints = skin["joints"]
    if missing := [joint for joint in joints if joint not in matrices]:
        raise MeshInvalid(f"malformed glTF: joint {missing[0]!r:.20} is not a node of the default scene")
    pose = np.stack([matrices[joint] for joint in joints])
    if "inverseBindMatrices" in skin:
        if document.item("accessors", skin["inverseBindMatrices"]).get("count") != len(joints):
            raise MeshInvalid(f"malformed glTF: expected {len(joints)} inverse bind matrices")
        inverse_bind = document.read(skin["inverseBindMatrices"]).astype(np.float64)
        pose = pose @ _affine(inverse_bind.reshape(-1, 4, 4).swapaxes(1, 2))
    blended, total = np.zeros((count, 4, 4)), np.zeros(count)
    influences = 0
    while f"JOINTS_{influences}" in attributes:
        index = vectors(document, attributes, f"JOINTS_{influences}", 4, count).astype(np.int64)
        weight = vectors(document, attributes, f"WEIGHTS_{influences}", 4, count)
        if index.size and (index.min() < 0 or index.max() >= len(joints)):
            raise MeshInvalid(
                f"malformed glTF: expected joints from 0 to {len(joints) - 1}, got {index.max()}"
            )
        for k in range(4):
            blended += weight[:, k, None, None] * pose[index[:, k]]
        total += weight.sum(1)
        influences += 1
    if not influences or (total <= 0).any():
        raise MeshInvalid("malformed glTF: a skinned mesh has vertices without joint weights")
    return blended / total[:, None, None]
