"""What files are: of a request, mesh formats, what their first bytes say, artifacts. Imports nothing of ours.

Edge, worker, client and engine all read this page, so that they cannot disagree.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from pathlib import PurePath

HEAD_BYTES = 1024  # of a file, enough for `recognise_mesh`
SILHOUETTE_THRESHOLD = 0.5  # of the way from the smallest to the largest level of the image itself


MESH = "mesh"
SILHOUETTE = "silhouette"
IGNORE = "ignore"
MAX_VIEWS = 8  # of one request, the first included


def of_view(part: str, number: int) -> str:
    """The name of a view's file, SILHOUETTE or IGNORE: `silhouette` of view 1, then `silhouette_2`, ..."""
    return part if number == 1 else f"{part}_{number}"


def address_of(part: str) -> str:
    """The name of the field that has the address of a file in the place of its bytes: `mesh_url`, ..."""
    return f"{part}_url"


IMAGE_PARTS = tuple(of_view(part, n) for n in range(1, MAX_VIEWS + 1) for part in (SILHOUETTE, IGNORE))
"""The names of all images that a request may have: parts over REST, file chunks over gRPC, blobs."""


class Damaged(ValueError):
    """A file that is not what it should be; the message says what was expected and what came."""


class Unsupported(ValueError):
    """A file of a format that is not read; the message says what is."""


class MeshFormat(StrEnum):
    """The mesh files that are read; unset: recognised from the bytes."""

    GLB = "glb"
    GLTF = "gltf"
    OBJ = "obj"
    PLY = "ply"
    STL = "stl"
    OFF = "off"
    ZIP = "zip"  # one of the others with the files that it refers to
    BINVOX = "binvox"
    NPZ = "npz"  # a voxel grid


MESH_SUFFIXES = tuple(f".{name}" for name in MeshFormat)
GLB_MAGIC, ZIP_MAGIC, BINVOX_MAGIC = b"glTF", b"PK\3\4", b"#binvox"
_OFF_MAGIC = re.compile(rb"\s*(ST|C|N|4|n)*OFF[\s\d#]")
_OBJ_TEXT = re.compile(rb"^[ \t]*v[ \t]+[-+.\d]+[ \t]+[-+.\d]+[ \t]+[-+.\d]+", re.MULTILINE)
_WITHOUT_MAGIC = (MeshFormat.OBJ, MeshFormat.STL, MeshFormat.OFF)  # comments may precede OFF's


def format_of_name(name: str) -> MeshFormat | None:
    """The format that the suffix of a file's name stands for, if any."""
    suffix = PurePath(name).suffix.lower()
    return MeshFormat(suffix[1:]) if suffix in MESH_SUFFIXES else None


def recognise_mesh(head: bytes, name: str | None = None, given: MeshFormat | None = None) -> MeshFormat:
    """The format of a mesh file: by its first bytes where they tell, else as `given`, else by its name.

    Raises Damaged for an empty file and for one that is not what it is called, else Unsupported.
    """
    if not head:
        raise Damaged("expected a mesh file, got an empty file (0 bytes)")
    start = head[:HEAD_BYTES].removeprefix(b"\xef\xbb\xbf")
    if start.startswith(GLB_MAGIC):
        return MeshFormat.GLB
    if start.startswith(BINVOX_MAGIC):
        return MeshFormat.BINVOX
    if start.startswith(ZIP_MAGIC):
        name_end = 30 + int.from_bytes(start[26:28], "little")  # of the first file in the archive
        return MeshFormat.NPZ if start[30:name_end].endswith(b".npy") else MeshFormat.ZIP
    if start.lstrip().startswith(b"{"):
        return MeshFormat.GLTF
    if re.match(rb"ply\s", start):
        return MeshFormat.PLY
    if _OFF_MAGIC.match(start):
        return MeshFormat.OFF
    called = given or format_of_name(name or "")
    if called in _WITHOUT_MAGIC:
        return called
    if called is not None:
        source = "as was said" if given else f"by the name {name!r:.60}"
        found = (
            "the text of an OBJ file; call it .obj"
            if _OBJ_TEXT.search(start)
            else f"{head[:8]!r} at its start"
        )
        raise Damaged(f"expected a {called.upper()} file {source}, got {found}")
    file = f"{name!r:.60}" if name else "a file"
    raise Unsupported(
        f"expected a mesh file ({', '.join(MESH_SUFFIXES)}), got {file} with unknown content; if it is one, "
        "give its name the suffix"
    )


class ArtifactName(StrEnum):
    """The files that a refinement makes, in the order in which they are listed."""

    REFINED = "refined.glb"
    CONFIDENCE_MESH = "confidence.glb"
    CONFIDENCE_IMAGE = "confidence.png"
    CONFIDENCE_ARRAYS = "confidence.npz"
    PREVIEW = "preview.png"
    REPORT = "report.json"


_MEDIA_TYPES: Mapping[str, str] = {
    ".glb": "model/gltf-binary",
    ".png": "image/png",
    ".npz": "application/zip",
    ".json": "application/json",
}
ARTIFACTS: Mapping[str, str] = {name: _MEDIA_TYPES[PurePath(name).suffix] for name in ArtifactName}
"""Name -> media type."""
