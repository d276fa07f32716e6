"""Files that a mesh refers to: beside it on disk, or with it in an archive."""

from __future__ import annotations

import io
import json
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from refine_engine.errors import FormatUnsupported, MeshInvalid
from refine_engine.files.beside import in_folder_of
from refine_engine.files.mesh_file import read_mesh

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def parts(tools: Any) -> dict[str, bytes]:
    """A .gltf with a buffer and a texture in files of their own."""
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json |= {
        "buffers": [{"byteLength": len(glb.binary), "uri": "the%20data.bin"}],
        "images": [{"uri": "textures/a.png"}],
    }
    return {
        "cube.gltf": json.dumps(glb.json).encode(),
        "the data.bin": glb.binary,
        "textures/a.png": b"\x89PNG",
    }


def packed(parts: dict[str, bytes], folder: str = "") -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in parts.items():
            archive.writestr(folder + name, data)
    return target.getvalue()


@pytest.mark.parametrize("folder", ["", "model/deep/"])
def test_a_gltf_in_an_archive_becomes_one_glb(parts: dict[str, bytes], folder: str) -> None:
    file = read_mesh(packed(parts, folder), "mesh.zip")
    assert len(file.mesh.vertices) == 8
    again = read_mesh(file.with_vertices(file.mesh.vertices, torch.ones(8)), "a.glb")
    assert torch.equal(again.mesh.vertices, file.mesh.vertices)


def test_a_gltf_is_read_with_the_files_beside_it(parts: dict[str, bytes], tmp_path: Path) -> None:
    (tmp_path / "textures").mkdir()
    for name, data in parts.items():
        (tmp_path / name).write_bytes(data)
    path = tmp_path / "cube.gltf"
    assert len(read_mesh(path.read_bytes(), path.name, beside=in_folder_of(path)).mesh.vertices) == 8
    with pytest.raises(FormatUnsupported, match=r"'the%20data\.bin'.*\.zip"):
        read_mesh(path.read_bytes(), path.name)


def test_a_missing_image_does_not_cost_the_mesh(parts: dict[str, bytes], tools: Any) -> None:
    """The reference stays, so that the image works again once it lies beside the result."""
    del parts["textures/a.png"]
    file = read_mesh(packed(parts), "mesh.zip")
    assert "1 images are not there (first: 'textures/a.png')" in file.warnings[0]
    head = tools.split_glb(file.with_vertices(file.mesh.vertices, torch.ones(8)))[0]
    assert head["images"] == [{"uri": "textures/a.png"}]


def test_nothing_outside_the_folder_is_read(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"x")
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "link").symlink_to(tmp_path / "secret")
    beside = in_folder_of(inner / "a.gltf")
    for uri in ("../secret", "%2e%2e/secret", str(tmp_path / "secret"), "link", "", "a\0b", "x" * 5000):
        assert beside(uri) is None


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (packed({"a.txt": b""}), "one mesh file .* got 0"),
        (packed({"a.obj": TRIANGLE, "b.obj": TRIANGLE}), r"got 2: a\.obj, b\.obj"),
        (packed({"../a.obj": TRIANGLE}), "paths inside the archive"),
        (packed({"/a.obj": TRIANGLE}), "paths inside the archive"),
        (packed({"a.obj": TRIANGLE, "Q": b""}).replace(b"Q", b"\0"), "paths inside the archive, got ''"),
        (packed({".": b""}), "one mesh file .* got 0"),
        (packed({"a.obj": TRIANGLE + b"\n" * 10_000_000}), "200 times its own"),
        (packed({f"{i}.txt": b"" for i in range(1001)}), "at most 1000 files"),
        (packed({"a.obj": packed({"a.obj": TRIANGLE})}), "another archive"),
        (packed({"a.obj": TRIANGLE})[:-9], "damaged ZIP"),
        (b"PK\3\4" + bytes(100), "damaged ZIP"),
    ],
)
def test_archives_are_read_under_limits(data: bytes, says: str) -> None:
    with pytest.raises(MeshInvalid, match=says):
        read_mesh(data, "mesh.zip")


def test_every_cut_and_every_changed_byte_of_an_archive_is_refused_or_read() -> None:
    good = packed({"a.obj": TRIANGLE})
    for at in range(len(good)):
        for data in (good[:at], good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :]):
            with suppress(MeshInvalid, FormatUnsupported):
                read_mesh(data, "mesh.zip")


def test_one_file_is_not_embedded_without_end(tools: Any) -> None:
    glb = tools.Glb()
    glb.mesh(tools.cube, tools.cube_faces)
    glb.json["buffers"] = [{"byteLength": 1, "uri": "a.bin"}] * 100
    with pytest.raises(MeshInvalid, match="bytes in the files"):
        read_mesh(json.dumps(glb.json).encode(), "a.gltf", beside=lambda uri: bytes(64 << 20))
