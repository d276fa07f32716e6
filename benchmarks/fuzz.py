"""Feeds changed mesh files to every reader, and prints how many were read, refused and neither.

    python benchmarks/fuzz.py --inputs 1000000 [--seed 0] [FILE ...]

The seeds are small files of each format and the given ones. A file is cut, its bytes and numbers are changed,
pieces of it are doubled and of two files joined. What is read is written and read again. A finding is an
error other than the two that a reader may raise, or an input that takes too long; it is written to
`fuzz-findings/`, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import random
import sys
import time
import warnings
import zipfile
from collections import Counter
from pathlib import Path

import DracoPy
import numpy as np
import torch

from refine_engine.errors import InputError
from refine_engine.files.draco import DRACO
from refine_engine.files.gltf import Document
from refine_engine.files.mesh_file import MeshLimits, read_mesh

LIMITS = MeshLimits(max_vertices=20_000, max_faces=50_000)
_CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_NUMBERS = [
    b"0",
    b"-1",
    b"1",
    b"2",
    b"3.5",
    b"1e999",
    b"nan",
    b"4294967295",
    b"-9223372036854775808",
    b"9" * 30,
]


def seeds() -> dict[str, list[bytes]]:
    """Small files by suffix."""
    rows = [f"{x} {y} {z}" for x, y, z in _CORNERS]
    quads = ["4 " + " ".join(map(str, quad)) for quad in _QUADS]
    obj = "mtllib a\nusemtl b\n" + "".join(f"v {row} 1 0 0\nvt 0 1\nvn 0 0 1\n" for row in rows)
    obj += "".join("f " + " ".join(f"{i + 1}/{i + 1}/-1" for i in quad) + " # c\n" for quad in _QUADS)
    xyz = "property float x\nproperty float y\nproperty float z\n"
    ply = f"ply\nformat ascii 1.0\nelement vertex 8\n{xyz}property uchar red\nproperty uchar green\n"
    ply += "property uchar blue\nelement face 6\nproperty list uchar int vertex_indices\nend_header\n"
    ply += "".join(f"{row} 1 2 3\n" for row in rows) + "\n".join(quads) + "\n"
    strips = f"ply\nformat ascii 1.0\nelement vertex 8\n{xyz}element tristrips 1\n"
    strips += (
        "property list int int vertex_indices\nend_header\n" + "\n".join(rows) + "\n9 0 1 2 3 -1 4 6 5 7\n"
    )
    stl = "solid a\n" + "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {rows[i]}\n" for i in quad[:3])
        + "endloop\nendfacet\n"
        for quad in _QUADS
    )
    off = "COFF\n8 6 0\n" + "".join(f"{row} 1 0 0 1\n" for row in rows) + "\n".join(quads) + "\n"
    found = {
        "obj": [obj.encode()],
        "ply": [ply.encode(), strips.encode()],
        "stl": [stl.encode() + b"endsolid a\n"],
        "off": [off.encode()],
    }
    file = read_mesh(found["obj"][0], "a.obj")
    found["glb"] = [file.with_vertices(file.mesh.vertices, torch.ones(8)), _draco()]
    found["zip"] = [_archive({"a.obj": obj, "a": "newmtl b\nKd 1 0 0\nmap_Kd -s 2 2 1 c.png\n"})]
    found["binvox"] = [b"#binvox 1\ndim 4 4 4\ntranslate 0 0 0\nscale 1\ndata\n\0\x15\1\2\0\2\1\2\0\x25"]
    grid, points = io.BytesIO(), np.random.default_rng(0).normal(size=(60, 3))
    np.savez(grid, grid=np.eye(4)[:, None] * np.ones(4), translate=np.zeros(3), scale=1.0)
    found["npz"] = [grid.getvalue()]
    places = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in points)
    cloud = f"ply\nformat ascii 1.0\nelement vertex 60\n{xyz}end_header\n{places}"
    found["ply"].append(cloud.encode())
    return found


def _archive(files: dict[str, str]) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return target.getvalue()


def _draco() -> bytes:
    """A GLB of the cube as Draco data."""
    triangles = np.array(
        [(a, b, c) for a, b, c, d in _QUADS] + [(a, c, d) for a, b, c, d in _QUADS], np.uint32
    )
    document = Document({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}, bytearray())
    view = document.append_bytes(DracoPy.encode(np.array(_CORNERS, np.float32), triangles))
    document.json |= {
        "nodes": [{"mesh": 0}],
        "accessors": [
            {"componentType": 5126, "count": 8, "type": "VEC3"},
            {"componentType": 5125, "count": 36, "type": "SCALAR"},
        ],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0},
                        "indices": 1,
                        "extensions": {DRACO: {"bufferView": view, "attributes": {"POSITION": 0}}},
                    }
                ]
            }
        ],
    }
    return document.to_glb()


def changed(data: bytes, other: bytes, chance: random.Random) -> bytes:
    """The file after one to eight changes."""
    for _ in range(chance.randint(1, 8)):
        at = chance.randrange(len(data) + 1)
        end = min(len(data), at + chance.choice((1, 2, 4, 16, 256)))
        match chance.randrange(7):
            case 0:
                data = data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]
            case 1:
                data = data[:at] + data[end:]
            case 2:
                data = data[:end] + data[at:end] * chance.choice((1, 2, 50)) + data[end:]
            case 3:
                data = data[:at] + chance.choice(_NUMBERS) + data[end:]
            case 4:
                data = (
                    data[:at]
                    + chance.choice((b" ", b"\n", b"\t", b"/", b"#", b"-", b"\0", b"\xff"))
                    + data[at:]
                )
            case 5:
                data = data[:at] + other[chance.randrange(len(other)) :][:256] + data[end:]
            case _:
                data = (
                    data[:at]
                    + chance.choice((0, 1, 255, 2**31, 2**32 - 1)).to_bytes(4, "little")
                    + data[at + 4 :]
                )
    return data


def outcome(data: bytes, name: str) -> str:
    """`read` or the reason of a refusal. Any other error of the reader or the writer comes through."""
    try:
        file = read_mesh(data, name, LIMITS)
    except InputError as error:
        if "\n" in str(error):
            raise AssertionError("a message of several lines") from error
        return error.reason
    vertices = file.mesh.vertices
    read_mesh(file.with_vertices(vertices, torch.ones(len(vertices))), "a.glb")
    return "read"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--slow-s", type=float, default=1.0, help="an input that takes longer is a finding")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("files", type=Path, nargs="*", metavar="FILE")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    chance, corpus = random.Random(arguments.seed), seeds()
    for path in arguments.files:
        corpus.setdefault(path.suffix[1:].lower(), []).append(path.read_bytes())
    every = [(kind, data) for kind, files in corpus.items() for data in files]
    counts: Counter[str] = Counter()
    slowest = 0.0
    for _ in range(arguments.inputs):
        kind, data = chance.choice(every)
        data = changed(data, chance.choice(every)[1], chance)
        begin = time.monotonic()
        try:
            found = outcome(data, f"a.{kind}")
        except Exception as error:
            found = f"FINDING {kind} {type(error).__name__}: {error!s:.100}"
        took = time.monotonic() - begin
        slowest = max(slowest, took)
        if took > arguments.slow_s:
            found = f"FINDING {kind}: took more than {arguments.slow_s} s"
        counts[found] += 1
        if found.startswith("FINDING") and counts[found] == 1:
            folder = Path("fuzz-findings")
            folder.mkdir(exist_ok=True)
            (folder / f"{hashlib.sha256(data).hexdigest()[:12]}.{kind}").write_bytes(data)
    print(f"{sum(counts.values())} inputs, slowest {slowest:.2f} s")
    for found, count in counts.most_common():
        print(f"{count:9} {found}")
    return int(any(found.startswith("FINDING") for found in counts))


if __name__ == "__main__":
    sys.exit(main())
