"""Bytes <-> Mesh. Reading a mesh gives a MeshFile, which can write the moved vertices back into what was
read.

docs/files.md says what is read, what survives and what is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refine_proto.formats import MeshFormat, recognise_mesh

from ..errors import MeshInvalid
from ..values import Mesh
from . import gltf
from .beside import Beside, open_archive
from .colour_scale import confidence_colours, linear_light
from .draco import decompress
from .gltf_edit import CONFIDENCE, keep_triangles, move_vertices, overwritable_accessors
from .gltf_geometry import SceneGeometry, read_scene, triangle_primitives
from .limits import MeshLimits, one_line, refused_as
from .materials import MATTE, Material
from .polygons import mesh_document, read_polygons
from .subdivide import subdivided
from .weld import Floats, Ints, Weld, smooth_groups, vertex_normals, weld

__all__ = ["DEFAULT_LIMITS", "MeshFile", "MeshLimits", "read_mesh"]
DEFAULT_LIMITS = MeshLimits()
UNLIT = "KHR_materials_unlit"


@dataclass(frozen=True)
class MeshFile:
    """A mesh file that was read: the mesh to optimise, and the way back into the file.

    S is the number of vertices in the file (of all placed instances), V that of the welded mesh.
    """

    mesh: Mesh  # (V) welded, world units, node transforms applied
    vertex_of_source: (
        Tensor  # (S,) int64: welded vertex of each vertex of the file, -1 where no triangle uses it
    )
    given_vertices: int  # welded, of the file as it came: its long edges may have been split since
    given_faces: int
    warnings: tuple[str, ...]
    _document: gltf.Document
    _scene: SceneGeometry
    _weld: Weld
    _overwritable: frozenset[int]

    @property
    def textured(self) -> bool:
        """Some triangles have texture coordinates."""
        return any(
            name.startswith("TEXCOORD_")
            for mesh in self._document.json.get("meshes", [])
            for primitive in triangle_primitives(mesh)
            for name in primitive["attributes"]
        )

    def with_vertices(self, vertices: Tensor, confidence: Tensor, kept: Tensor | None = None) -> bytes:
        """The file as a GLB with moved vertices (V, 3) in world units and their symmetry confidence (V,).

        Positions, normals, tangents, bounds and the attribute `_SYMMETRY_CONFIDENCE` are new, all else is as
        it was read. Vertices that no triangle uses stay where they are, with confidence 0. Of the mesh's
        triangles only those of `kept` (F,) bool are written, where that leaves a primitive any.
        """
        self._check(vertices, confidence)
        of_source = self._weld.vertex_of
        used = of_source >= 0
        before = self._scene.world_positions()
        moved = self._moved(vertices)
        after = np.where(used[:, None], moved[of_source], before)
        normals = self._scene.world_normals()
        group = smooth_groups(of_source, normals)
        shown = vertex_normals(before, after, self._scene.faces, group, normals)
        positions, local_normals = before.copy(), normals.copy()
        for placement in self._scene.placements:
            part = placement.source
            stays = ~used[part, None]
            moved_local = placement.moved(after[part], of_source[part])
            positions[part] = np.where(stays, placement.positions, moved_local)
            local = placement.normals_to_local(shown[part])
            local_normals[part] = np.where(
                stays & placement.normals.any(1, keepdims=True), placement.normals, local
            )
        sigma = np.where(used, confidence.detach().cpu().double().numpy()[of_source], 0.0)
        document = move_vertices(
            self._document, self._scene.placements, self._overwritable, positions, local_normals, sigma
        )
        if kept is not None and not kept.all():
            keep_triangles(document, self._scene.placements, self._kept_in_file(kept.cpu().numpy()))
        return document.to_glb()

    def _kept_in_file(self, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which triangles of the file are still there, as `kept` (F,) says of the welded mesh's."""
        removed = np.sort(self._weld.faces[~kept], axis=1)
        in_file = np.sort(self._weld.vertex_of[self._scene.faces], axis=1)
        width = len(self._weld.source_of) + 1  # rows as numbers; -1, of a vertex that was left out, becomes 0
        in_file, removed = (rows + 1 for rows in (in_file, removed))
        return ~np.isin(_row_number(in_file, width), _row_number(removed, width))

    def confidence_glb(self, vertices: Tensor, confidence: Tensor, faces: Tensor | None = None) -> bytes:
        """The welded mesh, or these of its faces, in the colours of `colour_scale`.

        Unlit, so that a viewer shows these colours and not what its lights make of them.
        """
        self._check(vertices, confidence)
        points = vertices.detach().cpu().double().numpy()
        shown = (self.mesh.faces if faces is None else faces).cpu().numpy()
        none = np.zeros_like(points)
        normals = vertex_normals(points, points, shown, np.arange(len(points)), none)
        rgb = linear_light(confidence_colours(confidence.detach().cpu().double().numpy()))
        part = {
            "POSITION": points.astype("<f4"),
            "NORMAL": normals.astype("<f4"),
            "COLOR_0": np.concatenate([rgb, np.ones((len(rgb), 1))], 1).astype("<f4"),
            CONFIDENCE: confidence.detach().cpu().numpy().astype("<f4")[:, None],
            "faces": shown,
        }
        # matte for viewers that light it all the same
        unlit = Material({**MATTE.json, "extensions": {UNLIT: {}}})
        document = mesh_document([(part, unlit)])
        document.json["extensionsUsed"] = [UNLIT]
        return document.to_glb()

    def _moved(self, vertices: Tensor) -> Floats:
        """New world positions (V, 3) in float64: the file's own positions plus what the optimisation moved
        them, so that a mesh far from the origin keeps its precision and an unmoved vertex its bits."""
        start = self._scene.world_positions()[self._weld.source_of]
        moved: Floats = start + (vertices.detach().cpu().double() - self.mesh.vertices.cpu().double()).numpy()
        return moved

    def _check(self, vertices: Tensor, confidence: Tensor) -> None:
        count = len(self.mesh.vertices)
        if tuple(vertices.shape) != (count, 3) or tuple(confidence.shape) != (count,):
            raise ValueError(
                f"expected vertices ({count}, 3) and confidence ({count},), "
                f"got {tuple(vertices.shape)} and {tuple(confidence.shape)}"
            )
        if not (torch.isfinite(vertices).all() and torch.isfinite(confidence).all()):
            raise ValueError("expected finite vertices and confidence, got NaN or infinity")


def _row_number(rows: Ints, width: int) -> Ints:
    return (rows[:, 0] * width + rows[:, 1]) * width + rows[:, 2]


def read_mesh(
    data: bytes,
    name: str,
    limits: MeshLimits = DEFAULT_LIMITS,
    beside: Beside | None = None,
    *,
    subdivide: bool = False,
) -> MeshFile:
    """Read a mesh, points or voxels of any `MeshFormat`, or a ZIP archive of one and the files it refers to.

    The format is decided by the content where it can be, else by the suffix of `name`. `beside` gives the
    files that a mesh refers to (buffers, images, materials); without it only embedded data is read.
    With `subdivide` long edges are split, see `subdivided`. Raises FormatUnsupported or MeshInvalid.
    """
    with refused_as(MeshInvalid):
        if (kind := recognise_mesh(data, name)) is MeshFormat.ZIP:
            name, data, beside = open_archive(data)
            if (kind := recognise_mesh(data, name)) is MeshFormat.ZIP:
                raise MeshInvalid(f"expected a mesh file in the archive, got another archive {name!r:.60}")
    with _malformed(kind):
        if kind in (MeshFormat.GLB, MeshFormat.GLTF):
            document = gltf.parse(data, beside)
            decompress(document, limits)
        else:
            document = read_polygons(data, kind, limits, beside)
    read = _read_document(document, kind, limits)
    finer = subdivided(document, read._scene) if subdivide else None
    if finer is None:
        return read
    split = _read_document(finer, kind, limits)
    told = f"the mesh was subdivided, from {read.given_vertices} to {split.given_vertices} vertices"
    return replace(
        split,
        given_vertices=read.given_vertices,
        given_faces=read.given_faces,
        warnings=(*split.warnings, told),
    )


def _read_document(document: gltf.Document, kind: str, limits: MeshLimits) -> MeshFile:
    with _malformed(kind):
        scene = read_scene(document, limits)
        overwritable = overwritable_accessors(document, {placement.node for placement in scene.placements})
    positions = scene.world_positions()
    welded = weld(positions, scene.faces)
    if not len(welded.faces):
        raise MeshInvalid(f"expected triangles with an area, got {len(scene.faces)} whose corners coincide")
    limits.check_welded(len(welded.source_of))
    vertices = torch.from_numpy(positions[welded.source_of].astype(np.float32))
    warnings = [*document.warnings, *scene.warnings]
    if dropped := len(scene.faces) - len(welded.faces):
        warnings.append(
            f"{dropped} of {len(scene.faces)} triangles have corners that coincide and were left out"
        )
    return MeshFile(
        mesh=Mesh(vertices, torch.from_numpy(welded.faces)),
        vertex_of_source=torch.from_numpy(welded.vertex_of),
        given_vertices=len(welded.source_of),
        given_faces=len(welded.faces),
        warnings=tuple(warnings),
        _document=document,
        _scene=scene,
        _weld=welded,
        _overwritable=overwritable,
    )


@contextmanager
def _malformed(kind: str) -> Iterator[None]:
    """Turn what untrusted structure trips over (a list where an object belongs) into MeshInvalid."""
    try:
        yield
    except (
        AttributeError,
        KeyError,
        IndexError,
        TypeError,
        ValueError,
        OverflowError,
        np.linalg.LinAlgError,
    ) as error:
        raise MeshInvalid(f"malformed {kind.upper()}: {one_line(error)}") from error
