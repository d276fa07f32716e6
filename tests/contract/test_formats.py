"""What the first bytes of a file say: the same to everybody, and for the same reasons."""

from __future__ import annotations

import struct

import pytest

from refine_engine.errors import InputError
from refine_engine.files.mesh_file import read_mesh
from refine_engine.files.png import read_silhouette
from refine_proto.errors import InvalidInput
from refine_proto.formats import (
    ARTIFACTS,
    MAX_IMAGE_SIDE,
    Damaged,
    MeshFormat,
    Unsupported,
    format_of_name,
    png_size,
    recognise_mesh,
)
from refine_service.edge import file_checks


def png_header(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBBI", 13, b"IHDR", width, height, 8, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("head", "name", "given", "found"),
    [
        (b"glTF\2\0\0\0", "a.obj", None, MeshFormat.GLB),  # the content decides before the name
        (b'\xef\xbb\xbf \n{"asset": 1}', None, MeshFormat.OBJ, MeshFormat.GLTF),
        (b"ply\r\nformat", None, None, MeshFormat.PLY),
        (b"  STCNOFF 3", None, None, MeshFormat.OFF),
        (b"# a comment\nOFF 3", "a.OFF", None, MeshFormat.OFF),
        (b"v 0 0 0", "a.obj", None, MeshFormat.OBJ),
        (b"v 0 0 0", "a.stl", MeshFormat.OBJ, MeshFormat.OBJ),  # what was said decides before the name
        (b"solid", "folder.obj/a.stl", None, MeshFormat.STL),
    ],
)
def test_mesh_formats(head: bytes, name: str | None, given: MeshFormat | None, found: MeshFormat) -> None:
    assert recognise_mesh(head, name, given) is found


def test_a_suffix_stands_for_a_format() -> None:
    assert [format_of_name(f"x.y{suffix}") for suffix in (".GLB", ".off", ".fbx", "")] == [
        "glb",
        "off",
        None,
        None,
    ]


BAD_MESHES = [
    (b"", "a.glb", "MESH_INVALID", "empty file"),
    (b"plymouth", "a.ply", "MESH_INVALID", r"expected a PLY file by the name 'a.ply', got b'plymouth'"),
    (b"# made by X\nv 0 1.5 -2\n", "a.glb", "MESH_INVALID", "got the text of an OBJ file; call it .obj"),
    (b"\0\1", "a.fbx", "FORMAT_UNSUPPORTED", r"\.glb, \.gltf, \.obj.*got 'a.fbx' with unknown content"),
    (b"\0\1", "", "FORMAT_UNSUPPORTED", "got a file with unknown content"),
]
BAD_IMAGES = [
    (b"", "SILHOUETTE_INVALID", "empty file"),
    (b"\xff\xd8\xff\xe0 JFIF", "FORMAT_UNSUPPORTED", "convert it to PNG"),
    (png_header(4, 4)[:20], "SILHOUETTE_INVALID", "truncated"),
    (png_header(0, 4), "SILHOUETTE_INVALID", "got 0x4"),
    (png_header(4, MAX_IMAGE_SIDE + 1), "SILHOUETTE_INVALID", "at most 4096 pixels a side, got 4x4097"),
]


@pytest.mark.parametrize(("head", "name", "reason", "says"), BAD_MESHES)
def test_edge_and_engine_refuse_a_mesh_alike(head: bytes, name: str, reason: str, says: str) -> None:
    with pytest.raises((Damaged, Unsupported), match=says):
        recognise_mesh(head, name)
    with pytest.raises(InvalidInput, match=says) as at_the_edge:
        file_checks.recognise_mesh(head, name, None)
    with pytest.raises(InputError, match=says) as in_the_engine:
        read_mesh(head, name)
    assert at_the_edge.value.reason == in_the_engine.value.reason == reason


@pytest.mark.parametrize(("head", "reason", "says"), BAD_IMAGES)
def test_edge_and_engine_refuse_a_silhouette_alike(head: bytes, reason: str, says: str) -> None:
    with pytest.raises(InvalidInput, match=says) as at_the_edge:
        file_checks.silhouette_size(head)
    with pytest.raises(InputError, match=says) as in_the_engine:
        read_silhouette(head)
    assert at_the_edge.value.reason == in_the_engine.value.reason == reason


def test_the_size_of_a_png() -> None:
    assert png_size(png_header(MAX_IMAGE_SIDE, 1)) == (4096, 1)


def test_artifacts_have_the_media_types_of_their_suffixes() -> None:
    assert next(iter(ARTIFACTS)) == "refined.glb"
    assert ARTIFACTS["refined.glb"] == ARTIFACTS["confidence.glb"] == "model/gltf-binary"
    assert set(ARTIFACTS.values()) == {
        "model/gltf-binary",
        "image/png",
        "application/zip",
        "application/json",
    }
