"""What the first bytes of an uploaded file say. The worker's reader decides in the same way, for good."""

from __future__ import annotations

import re
from pathlib import PurePath

from refine_proto.errors import FormatUnsupported, InvalidInput, MeshInvalid, SilhouetteInvalid
from refine_proto.models import FieldError, MeshFormat

HEAD_BYTES = 1024
MAX_SIDE = 4096  # pixels
_PNG = b"\x89PNG\r\n\x1a\n"
_OFF = re.compile(rb"\s*(ST|C|N|4|n)*OFF[\s\d#]")
_WITHOUT_MAGIC = (MeshFormat.OBJ, MeshFormat.STL, MeshFormat.OFF)  # comments may precede OFF's


def recognise_mesh(head: bytes, filename: str | None, given: MeshFormat | None) -> MeshFormat:
    """The format of a mesh file: by its content where that tells, else as given, else by the file's name."""
    if not head:
        raise _of("mesh", MeshInvalid, "expected a mesh file, got an empty file (0 bytes)")
    start = head.removeprefix(b"\xef\xbb\xbf")
    if start.startswith(b"glTF"):
        return MeshFormat.GLB
    if start.lstrip().startswith(b"{"):
        return MeshFormat.GLTF
    if re.match(rb"ply\s", start):
        return MeshFormat.PLY
    if _OFF.match(start):
        return MeshFormat.OFF
    named = given or _by_suffix(filename)
    if named in _WITHOUT_MAGIC:
        return named
    if named is not None:
        raise _of("mesh", MeshInvalid, f"expected a {named.upper()} file, got {head[:8]!r} at its start")
    known = ", ".join(MeshFormat)
    raise _of(
        "mesh_format",
        FormatUnsupported,
        f"expected a mesh file ({known}), got unknown content; name the format in mesh_format, or the file "
        "with its suffix",
    )


def silhouette_size(head: bytes) -> tuple[int, int]:
    """Width and height of a PNG file in pixels, from its header."""
    if not head:
        raise _of("silhouette", SilhouetteInvalid, "expected a PNG file, got an empty file (0 bytes)")
    if not head.startswith(_PNG):
        detail = f"expected a silhouette as a PNG file, got {head[:8]!r} at its start; convert it to PNG"
        raise _of("silhouette", FormatUnsupported, detail)
    if len(head) < 33 or head[12:16] != b"IHDR":
        detail = f"truncated PNG file: no image header in its {len(head)} bytes"
        raise _of("silhouette", SilhouetteInvalid, detail)
    width, height = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        detail = f"expected an image of at most {MAX_SIDE} pixels a side, got {width}x{height}"
        raise _of("silhouette", SilhouetteInvalid, detail)
    return width, height


def _by_suffix(filename: str | None) -> MeshFormat | None:
    suffix = PurePath(filename or "").suffix.lower().removeprefix(".")
    return MeshFormat(suffix) if suffix in list(MeshFormat) else None


def _of(part: str, error: type[InvalidInput], detail: str) -> InvalidInput:
    return error(detail, errors=[FieldError(pointer=f"/{part}", detail=detail)])
