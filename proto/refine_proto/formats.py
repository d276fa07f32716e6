"""What files are: mesh formats, what their first bytes say, limits, artifact names. Imports nothing of ours.

Edge, worker, client and engine all read this page, so that they cannot disagree.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import StrEnum
from pathlib import PurePath

HEAD_BYTES = 1024  # of a file, enough for `recognise_mesh` and `png_size`
MAX_IMAGE_SIDE = 4096  # pixels of a silhouette
SILHOUETTE_THRESHOLD = 0.25  # of full scale; below one half, because published masks are mostly alpha 127


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


MESH_SUFFIXES = tuple(f".{name}" for name in MeshFormat)
GLB_MAGIC, ZIP_MAGIC = b"glTF", b"PK\3\4"
_OFF_MAGIC = re.compile(rb"\s*(ST|C|N|4|n)*OFF[\s\d#]")
_OBJ_TEXT = re.compile(rb"^[ \t]*v[ \t]+[-+.\d]+[ \t]+[-+.\d]+[ \t]+[-+.\d]+", re.MULTILINE)
_WITHOUT_MAGIC = (MeshFormat.OBJ, MeshFormat.STL, MeshFormat.OFF)  # comments may precede OFF's
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


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
    if start.startswith(ZIP_MAGIC):
        return MeshFormat.ZIP
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


def png_size(head: bytes) -> tuple[int, int]:
    """Width and height in pixels of a PNG file, from its first bytes.

    Raises Damaged for an empty or truncated file and for one of more than MAX_IMAGE_SIDE, else Unsupported.
    """
    if not head:
        raise Damaged("expected a PNG file, got an empty file (0 bytes)")
    if not head.startswith(_PNG_SIGNATURE):
        raise Unsupported(
            f"expected a silhouette as a PNG file, got {head[:8]!r} at its start; convert it to PNG"
        )
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise Damaged(f"truncated PNG file: no image header in its {len(head)} bytes")
    width, height = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE):
        raise Damaged(f"expected an image of at most {MAX_IMAGE_SIDE} pixels a side, got {width}x{height}")
    return width, height


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
