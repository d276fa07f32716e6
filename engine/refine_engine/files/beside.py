"""The files that a mesh file refers to: those in its folder, or in the archive that it came in."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from refine_proto.formats import MESH_SUFFIXES

from ..errors import MeshInvalid
from .limits import one_line

Beside = Callable[[str], bytes | None]
"""The content of the file at a URI relative to the mesh file; None if there is none or it may not be read."""

_MAX_MEMBERS, _MAX_BYTES, _MAX_RATIO = 1000, 512 << 20, 200
_BROKEN = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError)


def in_folder_of(path: Path) -> Beside:
    """The files in the folder of the mesh file `path` and below; none that a link or `..` leads out of it."""
    folder = path.parent.resolve()

    def read(uri: str) -> bytes | None:
        try:
            found = (folder / unquote(uri)).resolve()
            return found.read_bytes() if found.is_relative_to(folder) and found.is_file() else None
        except (OSError, ValueError):  # a name that no file can have
            return None

    return read


def stays_inside(uri: str) -> bool:
    """Whether a URI means a file in the folder of whoever refers to it, or below, on any system."""
    path = PurePosixPath(unquote(uri))
    return not (path.is_absolute() or ".." in path.parts or "\\" in str(path) or ":" in str(path))


def open_archive(data: bytes) -> tuple[str, bytes, Beside]:
    """Name and content of the one mesh in a zip archive, and the files beside it. Raises MeshInvalid."""
    archive = checked_archive(data)
    members = {info.filename: info for info in archive.infolist() if not info.is_dir()}
    meshes = [name for name in members if _is_mesh(name)]
    if len(meshes) != 1:
        raise MeshInvalid(
            f"expected one mesh file ({', '.join(MESH_SUFFIXES)}) in the archive, got {len(meshes)}: "
            f"{', '.join(meshes)!s:.80}"
        )
    folder = PurePosixPath(meshes[0]).parent

    def read(uri: str) -> bytes | None:
        info = members.get(str(folder / unquote(uri)))
        return None if info is None else member_content(archive, info)

    return PurePosixPath(meshes[0]).name, member_content(archive, members[meshes[0]]), read


def checked_archive(data: bytes, ratio: int = _MAX_RATIO) -> zipfile.ZipFile:
    """An archive within the limits, unpacked at most `ratio` times as large; nothing is unpacked yet.

    Raises MeshInvalid.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except _BROKEN as error:
        raise MeshInvalid(f"damaged ZIP file: {one_line(error)}") from error
    _check(archive.infolist(), len(data), ratio)
    return archive


def _is_mesh(name: str) -> bool:
    path = PurePosixPath(name)
    suffix = path.suffix.lower()
    hidden = path.name.startswith(".") or "__MACOSX" in path.parts[:1]
    return suffix in MESH_SUFFIXES and suffix != ".zip" and not hidden


def _check(members: list[zipfile.ZipInfo], size: int, ratio: int) -> None:
    """By the directory of the archive, before a member is unpacked; `member_content` holds them to it."""
    if len(members) > _MAX_MEMBERS:
        raise MeshInvalid(f"expected at most {_MAX_MEMBERS} files in the archive, got {len(members)}")
    total = sum(info.file_size for info in members)
    if total > min(_MAX_BYTES, ratio * size):
        raise MeshInvalid(
            f"expected an archive of at most {_MAX_BYTES} bytes unpacked, and {ratio} times its own "
            f"{size}, got {total}"
        )
    for info in members:
        path = PurePosixPath(info.filename)
        if not info.filename or path.is_absolute() or ".." in path.parts or "\\" in info.filename:
            raise MeshInvalid(f"expected paths inside the archive, got {info.filename!r:.60}")
        if info.flag_bits & 1:
            raise MeshInvalid(f"expected an archive without a password, got {info.filename!r:.60}")


def member_content(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """A file of the archive, of the size that it announces. Raises MeshInvalid."""
    content = member_head(archive, info, info.file_size + 1)
    if len(content) != info.file_size:
        raise MeshInvalid(f"damaged ZIP file: {info.filename!r:.60} has not the size that it announces")
    return content


def member_head(archive: zipfile.ZipFile, info: zipfile.ZipInfo, size: int) -> bytes:
    """At most the first `size` bytes of a file of the archive. Raises MeshInvalid."""
    try:
        with archive.open(info) as member:
            return member.read(size)
    except _BROKEN as error:
        raise MeshInvalid(f"damaged ZIP file: {info.filename!r:.60}: {one_line(error)}") from error
