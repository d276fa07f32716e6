"""OFF with its variants (STOFF, COFF, NOFF), one vertex and one polygon per line."""

from __future__ import annotations

import re

import numpy as np

from ..errors import FormatUnsupported, MeshInvalid
from .limits import MeshLimits
from .surface import Part, Polygons, colours, texture_coordinates
from .weld import Floats

_HEADER = re.compile(rb"((?:ST|C|N)*)OFF(?![A-Za-z])")


def read_off(data: bytes, limits: MeshLimits) -> Polygons:
    """Read the polygons. Raises MeshInvalid, or ValueError for words that are no numbers."""
    lines = [words for line in data.splitlines() if (words := line.partition(b"#")[0].split())]
    header = _HEADER.match(lines[0][0]) if lines else None
    if header is None:
        raise FormatUnsupported(
            "expected OFF, STOFF, COFF or NOFF in three dimensions; export as OBJ, PLY or GLB"
        )
    lines[0] = [
        word for word in (lines[0][0][header.end() :], *lines[0][1:]) if word
    ]  # "OFF8 6 12" is written too
    if lines[0][:1] == [b"BINARY"]:
        raise FormatUnsupported("expected OFF as text, got binary OFF; export as text, PLY or GLB")
    counts, body = (lines[0], lines[1:]) if lines[0] else ((lines[1:2] or [[]])[0], lines[2:])
    if len(counts) < 2:
        raise MeshInvalid("damaged OFF file: expected the numbers of vertices and faces after the header")
    vertices, faces = (int(word[:20]) for word in counts[:2])
    limits.check_source(max(vertices, 0), max(faces, 0))
    if vertices < 0 or faces < 0 or vertices + faces > len(body):
        raise MeshInvalid(
            f"truncated OFF file: expected {vertices} vertices and {faces} faces, got {len(body)} lines"
        )
    if not faces:
        raise MeshInvalid(f"expected triangles or polygons in the OFF file, got none among {vertices} points")
    return _polygons(header[1], body[:vertices], body[vertices : vertices + faces])


def _polygons(prefix: bytes, vertices: list[list[bytes]], faces: list[list[bytes]]) -> Polygons:
    width = min(len(row) for row in vertices)
    if width < 3:
        raise MeshInvalid(f"damaged OFF file: expected at least three numbers per vertex, got {width}")
    table = np.array([row[:width] for row in vertices], np.float64)
    of_vertex, of_corner, warnings = _attributes(prefix, table, vertices), {}, []
    sizes = np.array([int(row[0][:20]) for row in faces], np.int64)
    if any(size < 0 or size >= len(row) for size, row in zip(sizes.tolist(), faces, strict=True)):
        raise MeshInvalid("damaged OFF file: expected as many indices in the line of a face as it announces")
    corners = np.array(
        [int(w[:20]) for row, n in zip(faces, sizes.tolist(), strict=True) for w in row[1 : n + 1]]
    )
    told = [row[n + 1 : n + 5] for row, n in zip(faces, sizes.tolist(), strict=True)]
    if any(len(colour) >= 3 for colour in told):
        if "COLOR_0" in of_vertex:
            warnings.append("the file colours vertices and faces; the colours of the faces were left out")
        else:
            values = np.array([c[:3] if len(c) >= 3 else [b"nan"] * 3 for c in told], np.float64)
            white = np.isnan(values).any(1)
            rgba = colours(values, _full(values, [word for colour in told for word in colour]))
            rgba[white] = 65535
            of_corner["COLOR_0"] = rgba, np.repeat(np.arange(len(faces)), sizes)
    elif any(told):
        warnings.append("the colours of the faces are numbers of a table that OFF does not hold; left out")
    return Polygons(
        table[:, :3], corners.astype(np.int64), sizes, of_vertex, of_corner, warnings=tuple(warnings)
    )


def _attributes(prefix: bytes, table: Floats, words: list[list[bytes]]) -> Part:
    """Behind the position come the normal (N), the colour (C, or unsaid) and texture coordinates (ST)."""
    part: Part = {}
    at, end = 3, table.shape[1]
    if b"N" in prefix and end >= at + 3:
        part["NORMAL"] = table[:, at : at + 3].astype("<f4")
        at += 3
    if b"ST" in prefix and end >= at + 2:
        end -= 2
        part["TEXCOORD_0"] = texture_coordinates(table[:, end : end + 2])
    if end - at in (3, 4):
        values = table[:, at:end]
        part["COLOR_0"] = colours(values, _full(values, [word for row in words for word in row[at:end]]))
    return part


def _full(values: Floats, words: list[bytes]) -> float:
    """The largest value of a colour: whole numbers above 1 are of 8 bits, others reach to 1."""
    whole = not any(b"." in word or b"e" in word for word in words)
    return 255.0 if np.nanmax(values, initial=0.0) > 1 and (whole or np.nanmax(values) > 2) else 1.0
