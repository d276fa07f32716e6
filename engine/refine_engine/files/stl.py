"""STL, binary and as text: triangles without shared corners."""

from __future__ import annotations

import numpy as np

from ..errors import MeshInvalid
from .limits import MeshLimits
from .surface import Polygons


def is_binary_stl(data: bytes) -> bool:
    return len(data) >= 84 and int.from_bytes(data[80:84], "little") * 50 + 84 == len(data)


def read_stl(data: bytes, limits: MeshLimits) -> Polygons:
    """Read the triangles. Raises MeshInvalid, or ValueError for words that are no numbers."""
    if is_binary_stl(data):
        count = (len(data) - 84) // 50
        limits.check_source(0, count)
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        positions = np.frombuffer(data, record, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    else:
        rows = [words[1:4] for line in data.splitlines() if (words := line.split()) and words[0] == b"vertex"]
        limits.check_source(0, len(rows) // 3)
        if len(rows) % 3 or b"endsolid" not in data:
            raise MeshInvalid("truncated or damaged STL file: expected binary STL, or text up to endsolid")
        if any(len(row) < 3 for row in rows):
            raise MeshInvalid("damaged STL file: expected three numbers in a line of vertex")
        positions = np.array(rows, np.float64).reshape(-1, 3)
    if not len(positions):
        raise MeshInvalid("expected triangles in the STL file, got none")
    corners = np.arange(len(positions))
    return Polygons(positions, corners, np.full(len(positions) // 3, 3), {}, {})
