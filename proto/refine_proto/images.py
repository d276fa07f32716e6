"""What an image file is, from its header alone: its format, its size and how it is to be turned.

Edge and engine both read this page, so that they cannot disagree; no pixel is decoded here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import BinaryIO, Literal, TypeAlias

from .formats import Damaged, Unsupported

_Order: TypeAlias = Literal["little", "big"]
_Read: TypeAlias = tuple[tuple[int, int], int]  # stored width and height, orientation

MAX_IMAGE_SIDE = 4096  # pixels of a silhouette
_MAX_PARTS = 2**16  # of a file that is looked through for its orientation
_EXIF = b"Exif\0\0"
_ORIENTATION, _WIDTH, _HEIGHT = 274, 256, 257  # tags of TIFF, which are EXIF's too
_ORDERS: Mapping[bytes, _Order] = {b"II*\0": "little", b"MM\0*": "big"}
_TURNED = range(5, 9)  # the orientations that swap width and height


class ImageFormat(StrEnum):
    """The image files that are read, by the names that Pillow has for them."""

    PNG = "PNG"
    JPEG = "JPEG"
    WEBP = "WEBP"
    TIFF = "TIFF"
    BMP = "BMP"


_MAGIC = {
    ImageFormat.PNG: (b"\x89PNG\r\n\x1a\n",),
    ImageFormat.JPEG: (b"\xff\xd8\xff",),
    ImageFormat.TIFF: tuple(_ORDERS),
    ImageFormat.BMP: (b"BM",),
}
_NOT_READ = {
    b"GIF8": "a GIF file",
    b"8BPS": "a PSD file",
    b"%PDF": "a PDF file",
    b"II+\0": "a BigTIFF file",
    b"MM\0+": "a BigTIFF file",
    b"v/1\x01": "an OpenEXR file",
    b"\0\0\0\x0cjP": "a JPEG 2000 file",
    b"<svg": "an SVG file",
    b"<?xml": "an SVG file",
    b"\x93NUMPY": "a NumPy file",
}


@dataclass(frozen=True)
class ImageHeader:
    """What the header of an image file tells."""

    format: ImageFormat
    stored_size: tuple[int, int]  # width, height in pixels
    orientation: int  # EXIF's: 1 as stored ... 8

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels as the image is shown, turned as its orientation says."""
        width, height = self.stored_size
        return (height, width) if self.orientation in _TURNED else (width, height)


def read_image_header(file: BinaryIO) -> ImageHeader:
    """The header of a file that can be sought in; leaves it at its beginning.

    Raises Damaged for an empty or truncated file and for one of more than MAX_IMAGE_SIDE, else Unsupported.
    """
    kind = _recognise(_at(file, 0, 16))
    try:
        (width, height), orientation = _READERS[kind](file)
    except (LookupError, ValueError):
        raise Damaged(f"truncated {kind} file: no image header in it") from None
    finally:
        file.seek(0)
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE):
        raise Damaged(f"expected an image of at most {MAX_IMAGE_SIDE} pixels a side, got {width}x{height}")
    return ImageHeader(kind, (width, height), orientation if 1 <= orientation <= 8 else 1)


def _recognise(start: bytes) -> ImageFormat:
    if not start:
        raise Damaged("expected an image file, got an empty file (0 bytes)")
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return ImageFormat.WEBP
    for kind, magic in _MAGIC.items():
        if start.startswith(magic):
            return kind
    told = (name for magic, name in _NOT_READ.items() if start.startswith(magic))
    got = next(told, "a HEIF or AVIF file" if start[4:8] == b"ftyp" else f"{start[:8]!r} at its start")
    raise Unsupported(
        f"expected an image as a PNG, JPEG, WebP, TIFF or BMP file, got {got}; convert it to PNG"
    )


# ---- one reader for each format: file -> ((width, height), orientation); IndexError or ValueError if cut off


def _png(file: BinaryIO) -> _Read:
    head = _exactly(file, 8, 25)
    if head[4:8] != b"IHDR":
        raise ValueError("no IHDR")
    size = _number(head[8:12], "big"), _number(head[12:16], "big")
    parts = _parts(file, 8, lambda part: (part[4:8], _number(part[:4], "big"), 12))
    return size, _orientation_in(file, parts, b"eXIf")


def _jpeg(file: BinaryIO) -> _Read:
    at, orientation = 2, 1
    for _ in range(_MAX_PARTS):
        while (marker := _exactly(file, at, 2))[1] == 0xFF:  # padding
            at += 1
        if marker[0] != 0xFF:
            raise ValueError("no marker")
        length = _number(_exactly(file, at + 2, 2), "big")
        if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC):  # start of a frame
            frame = _exactly(file, at + 5, 4)
            return (_number(frame[2:], "big"), _number(frame[:2], "big")), orientation
        if marker[1] == 0xE1 and _at(file, at + 4, 6) == _EXIF:
            orientation = _exif_orientation(file, at + 4)
        at += 2 + length
    raise ValueError("no frame")


def _webp(file: BinaryIO) -> _Read:
    kind, body = _exactly(file, 12, 4), _exactly(file, 20, 10)
    match kind:
        case b"VP8 ":
            return (_number(body[6:8], "little") & 0x3FFF, _number(body[8:10], "little") & 0x3FFF), 1
        case b"VP8L":
            bits = _number(body[1:5], "little")
            return ((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1), 1
        case b"VP8X":
            size = _number(body[4:7], "little") + 1, _number(body[7:10], "little") + 1
            parts = _parts(file, 12, _riff_part)
            return size, _orientation_in(file, parts, b"EXIF") if body[0] & 8 else 1
    raise ValueError("no image")


def _riff_part(part: bytes) -> tuple[bytes, int, int]:
    length = _number(part[4:8], "little")
    return part[:4], length, 8 + length % 2


def _tiff(file: BinaryIO) -> _Read:
    tags = _tiff_tags(file, 0)
    return (tags[_WIDTH], tags[_HEIGHT]), tags.get(_ORIENTATION, 1)


def _bmp(file: BinaryIO) -> _Read:
    if _number(_exactly(file, 14, 4), "little") == 12:  # OS/2
        size = _exactly(file, 18, 4)
        return (_number(size[:2], "little"), _number(size[2:], "little")), 1
    size = _exactly(file, 18, 8)
    width, height = (int.from_bytes(part, "little", signed=True) for part in (size[:4], size[4:]))
    return (width, abs(height)), 1  # negative: from the top down


_READERS: Mapping[ImageFormat, Callable[[BinaryIO], _Read]] = {
    ImageFormat.PNG: _png,
    ImageFormat.JPEG: _jpeg,
    ImageFormat.WEBP: _webp,
    ImageFormat.TIFF: _tiff,
    ImageFormat.BMP: _bmp,
}


# ---- what they share


def _orientation_in(file: BinaryIO, parts: Iterator[tuple[bytes, int]], kind: bytes) -> int:
    place = next((at for name, at in parts if name == kind), None)
    return 1 if place is None else _exif_orientation(file, place)


def _parts(
    file: BinaryIO, at: int, read: Callable[[bytes], tuple[bytes, int, int]]
) -> Iterator[tuple[bytes, int]]:
    """The chunks of a PNG or RIFF file: name and where the content begins."""
    for _ in range(_MAX_PARTS):
        head = _at(file, at, 8)
        if len(head) < 8:
            return
        name, length, around = read(head)
        yield name, at + 8
        at += length + around


def _exif_orientation(file: BinaryIO, at: int) -> int:
    """1 where the EXIF data at `at` are damaged: they are no part of the picture."""
    try:
        return _tiff_tags(file, at + len(_EXIF) if _at(file, at, 6) == _EXIF else at).get(_ORIENTATION, 1)
    except (LookupError, ValueError):
        return 1


def _tiff_tags(file: BinaryIO, base: int) -> dict[int, int]:
    """The tags of the first directory that hold one small number."""
    order = _ORDERS[_exactly(file, base, 4)]
    at = base + _number(_exactly(file, base + 4, 4), order)
    entries = _exactly(file, at + 2, 12 * _number(_exactly(file, at, 2), order))
    tags = {}
    for entry in (entries[i : i + 12] for i in range(0, len(entries), 12)):
        kind = _number(entry[2:4], order)
        if kind in (3, 4) and _number(entry[4:8], order) == 1:  # one SHORT or LONG
            tags[_number(entry[:2], order)] = _number(entry[8 : 10 if kind == 3 else 12], order)
    return tags


def _number(data: bytes, order: _Order) -> int:
    return int.from_bytes(data, order)


def _at(file: BinaryIO, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count)


def _exactly(file: BinaryIO, at: int, count: int) -> bytes:
    data = _at(file, at, count)
    if len(data) < count:
        raise IndexError(at)
    return data
