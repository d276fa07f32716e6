"""Voxel grids become meshes at the right place, and untrusted ones are refused by their headers."""

from __future__ import annotations

import io
import random
import struct
import zipfile
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from refine_engine.errors import FormatUnsupported, MeshInvalid
from refine_engine.files.mesh_file import MeshFile, MeshLimits, read_mesh
from refine_proto.formats import MeshFormat, recognise_mesh

BOX = np.zeros((10, 8, 6), bool)  # occupied: x 2..7, y 1..3, z 3..5
BOX[2:8, 1:4, 3:6] = True


def binvox(grid: NDArray[Any], place: str = "translate -1 0 2\nscale 5\n") -> bytes:
    """Sizes and runs of at most 255 cells, both in the order x, z, y."""
    stored = np.asarray(grid, np.uint8).transpose(0, 2, 1)
    flat = stored.ravel()
    starts = np.flatnonzero(np.r_[True, flat[1:] != flat[:-1]])
    runs = b""
    for start, end in zip(starts, [*starts[1:], len(flat)], strict=True):
        while start < end:
            runs += bytes([flat[start], min(255, end - start)])
            start += 255
    return f"#binvox 1\ndim {' '.join(map(str, stored.shape))}\n{place}data\n".encode() + runs


def npz(**arrays: Any) -> bytes:
    target = io.BytesIO()
    np.savez_compressed(target, **arrays)
    return target.getvalue()


def solid(file: MeshFile) -> Any:
    return trimesh.Trimesh(file.mesh.vertices.numpy(), file.mesh.faces.numpy(), process=False)


def test_a_binvox_lies_where_its_header_says() -> None:
    """Cells are half a unit: 5 / 10. The surface passes half a cell outside the outermost centres."""
    mesh = solid(read_mesh(binvox(BOX), "a.binvox"))
    low, high = mesh.bounds
    np.testing.assert_allclose(low, np.array([2, 1, 3]) * 0.5 + [-1, 0, 2], atol=1e-6)
    np.testing.assert_allclose(high, np.array([8, 4, 6]) * 0.5 + [-1, 0, 2], atol=1e-6)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6 * 3 * 3 * 0.5**3, rel=0.15)  # its edges are cut off


def test_an_npz_lies_around_the_origin_or_where_it_says() -> None:
    file = read_mesh(npz(occupancy=BOX), "a.npz")
    assert "no translate and scale" in file.warnings[0]
    low, high = solid(file).bounds
    np.testing.assert_allclose(low, np.array([2, 1, 3]) / 10 - [0.5, 0.4, 0.3], atol=1e-6)
    np.testing.assert_allclose(high, np.array([8, 4, 6]) / 10 - [0.5, 0.4, 0.3], atol=1e-6)
    told = read_mesh(npz(a=BOX, translate=np.array([-1.0, 0, 2]), scale=5.0), "a.npz")
    assert not told.warnings
    assert torch.equal(told.mesh.vertices, read_mesh(binvox(BOX), "a.binvox").mesh.vertices)


@pytest.mark.parametrize("sign", [1, -1])
def test_signed_distances_and_occupancies_give_a_smooth_sphere(sign: int) -> None:
    axes = np.indices((40, 40, 40)) - 19.5
    distance = np.linalg.norm(axes, axis=0) - 12
    for grid in (sign * distance, (1 / (1 + np.exp(distance))).astype(np.float16)):
        mesh = solid(read_mesh(npz(grid=grid), "a.npz"))
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 12 / 40, rtol=0.01)
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=0.02)


def test_an_object_that_reaches_the_border_is_closed() -> None:
    assert solid(read_mesh(npz(grid=np.ones((3, 4, 5), np.uint8)), "a.npz")).is_watertight


def test_the_content_tells_an_npz_from_another_archive() -> None:
    assert recognise_mesh(npz(grid=BOX), "a.zip") is MeshFormat.NPZ
    assert recognise_mesh(binvox(BOX), "a.obj") is MeshFormat.BINVOX
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("a.obj", b".npy")
    assert recognise_mesh(target.getvalue(), "a.npz") is MeshFormat.ZIP


def npy(head: str) -> bytes:
    text = head.encode() + b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text


def archive_of(content: bytes) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("grid.npy", content)
    return target.getvalue()


HUGE = "{'descr': '|b1', 'fortran_order': False, 'shape': (4096, 4096, 4096), }"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (npz(points=np.zeros((9, 3))), "one array of three dimensions in the NPZ file, got 0 among points"),
        (npz(a=BOX, b=BOX), "got 2 among a, b"),
        (npz(a=BOX * 0), "an inside and an outside"),
        (npz(a=BOX * 173.0), r"occupancies from 0 to 1 or signed distances in the grid, got up to 173"),
        (npz(a=np.where(BOX, np.nan, 0.0)), "finite values"),
        (npz(a=np.array([[["x"]]])), "arrays of numbers"),
        (npz(a=BOX, translate=[1, 2], scale=1), "3 numbers in 'translate.npy'"),
        (npz(a=BOX, translate=[1, 2, 3], scale=-1), "positive scale"),
        (archive_of(npy(HUGE)), "has not the size it announces"),
        (archive_of(npy(HUGE.replace("4096, 4096", "-1, -1"))), "NPZ"),
        (archive_of(npy(HUGE.replace("|b1", "|O"))), "arrays of numbers"),
        (archive_of(b"\x93NUMPY\1\0"), "malformed NPZ"),
        (npz(a=BOX)[:-30], "damaged ZIP"),
        (npz(a=np.zeros((1, 2**13, 2**12), bool)), "at most 16777216 cells"),
        (binvox(BOX)[:-2], "expected .10, 6, 8. cells, got"),
        (binvox(BOX).replace(b"\ndata\n", b"\ndato\n"), "a header up to a line 'data'"),
        (binvox(BOX).replace(b"dim 10 6 8", b"dim 99999 99999 99999"), "at most 16777216 cells"),
        (binvox(BOX).replace(b"dim 10 6 8", b"dim 10 8"), "three dimensions"),
        (binvox(BOX).replace(b"dim 10 6 8", b"dim 0 8 6"), "three dimensions"),
        (binvox(BOX).replace(b"dim", b"dem"), "malformed BINVOX"),
        (binvox(BOX, "translate 1 2\nscale 1\n"), "three finite numbers"),
        (binvox(BOX, "translate nan 2 3\nscale 1\n"), "three finite numbers"),
    ],
)  # fmt: skip
def test_refused(data: bytes, says: str) -> None:
    with pytest.raises(MeshInvalid, match=says) as caught:
        read_mesh(data, "a.npz")
    assert "\n" not in str(caught.value)


def test_a_bomb_is_refused_before_it_is_unpacked() -> None:
    """Half a gigabyte in half a megabyte, whose header announces as much."""
    zeros = npy("{'descr': '|b1', 'fortran_order': False, 'shape': (1024, 1024, 512), }") + bytes(2**29)
    data = archive_of(zeros)
    assert len(data) < 2**20
    with pytest.raises(MeshInvalid, match="at most"):
        read_mesh(data, "a.npz")


def test_a_surface_that_would_be_too_large_is_refused_before_it_is_made() -> None:
    checkers = np.indices((64, 64, 64)).sum(0) % 2
    with pytest.raises(MeshInvalid, match="at most 3000 vertices"):
        read_mesh(npz(grid=checkers), "a.npz", MeshLimits(max_vertices=500))


@pytest.mark.parametrize("good", [binvox(BOX), npz(grid=BOX)])
def test_changed_bytes_are_refused_or_read(good: bytes) -> None:
    chance = random.Random(0)
    for _ in range(1500):
        data = bytearray(good)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        with suppress(MeshInvalid, FormatUnsupported):
            read_mesh(bytes(data), "a.npz")
