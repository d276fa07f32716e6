"""What the first bytes of a file say: the same to everybody, and for the same reasons."""

from __future__ import annotations

import io
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from refine_engine.errors import InputError
from refine_engine.files.mesh_file import read_mesh
from refine_engine.files.silhouette import read_silhouette
from refine_proto.errors import InvalidInput
from refine_proto.formats import (
    ARTIFACTS,
    Damaged,
    MeshFormat,
    Unsupported,
    format_of_name,
    recognise_mesh,
)
from refine_proto.images import MAX_IMAGE_SIDE, ImageFormat, read_image_header
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
        (b"#binvox 1\n", "a.obj", None, MeshFormat.BINVOX),
        (b"PK\3\4" + bytes(22) + b"\5\0\0\0a.npybytes", "a.zip", None, MeshFormat.NPZ),
        (b"PK\3\4" + bytes(22) + b"\5\0\0\0a.obj.npy", "a.npz", None, MeshFormat.ZIP),
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
    (b"GIF89a...", "FORMAT_UNSUPPORTED", "got a GIF file; convert it to PNG"),
    (b"\0\0\0\x18ftypheic", "FORMAT_UNSUPPORTED", "got a HEIF or AVIF file"),
    (b"solid", "FORMAT_UNSUPPORTED", "got b'solid' at its start"),
    (b"\xff\xd8\xff\xe0 JFIF", "SILHOUETTE_INVALID", "truncated JPEG"),
    (b"II*\0\xff\0\0\0", "SILHOUETTE_INVALID", "truncated TIFF"),
    (b"RIFF\0\0\0\0WEBPVP8 ", "SILHOUETTE_INVALID", "truncated WEBP"),
    (b"BM", "SILHOUETTE_INVALID", "truncated BMP"),
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
        file_checks.image_size(io.BytesIO(head), "silhouette")
    with pytest.raises(InputError, match=says) as in_the_engine:
        read_silhouette(head)
    assert at_the_edge.value.reason == in_the_engine.value.reason == reason


def picture(kind: str, orientation: int, size: tuple[int, int] = (30, 20)) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    stream = io.BytesIO()
    Image.new("RGB", size, (1, 2, 3)).save(stream, kind, exif=exif)
    return stream.getvalue()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", list(ImageFormat))
def test_the_header_of_an_image_is_what_pillow_decodes(kind: ImageFormat, orientation: int) -> None:
    data = picture(kind, orientation)
    header = read_image_header(io.BytesIO(data))
    with Image.open(io.BytesIO(data)) as image:
        assert header.format == image.format
        assert header.orientation == image.getexif().get(0x0112, 1)
        assert header.size == ImageOps.exif_transpose(image).size


@given(data=st.data(), kind=st.sampled_from(ImageFormat), orientation=st.integers(1, 8))
def test_a_damaged_header_is_refused_or_read(
    data: st.DataObject, kind: ImageFormat, orientation: int
) -> None:
    content = bytearray(picture(kind, orientation))
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        size = read_image_header(io.BytesIO(bytes(content[: data.draw(st.integers(0, len(content)))]))).size
    except (Damaged, Unsupported):
        return
    assert 0 < min(size) <= max(size) <= MAX_IMAGE_SIDE


def test_artifacts_have_the_media_types_of_their_suffixes() -> None:
    assert next(iter(ARTIFACTS)) == "refined.glb"
    assert ARTIFACTS["refined.glb"] == ARTIFACTS["confidence.glb"] == "model/gltf-binary"
    assert set(ARTIFACTS.values()) == {
        "model/gltf-binary",
        "image/png",
        "application/zip",
        "application/json",
    }
