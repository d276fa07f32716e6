from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from PIL import Image

from refine_engine.errors import FormatUnsupported, InputError, SilhouetteInvalid
from refine_engine.files.png import read_silhouette

DISC = np.hypot(*(np.mgrid[0:20, 0:30] - np.array([10, 12])[:, None, None])) < 6  # 20 high, 30 wide


def png(array: Any, mode: str | None = None, **options: Any) -> bytes:
    image = Image.fromarray(array)
    stream = io.BytesIO()
    (image.convert(mode) if mode else image).save(stream, "PNG", **options)
    return stream.getvalue()


def rgba(colour: Any, alpha: Any) -> Any:
    layers = [np.broadcast_to(layer, DISC.shape) for layer in (colour, colour, colour, alpha)]
    return np.dstack(layers).astype(np.uint8)


def raw_png(rows: Any, bits: int) -> bytes:
    """A grey PNG of 16 bits, or packed bits, written without a library."""
    height, width = rows.shape

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    lines = [row.astype(">u2").tobytes() if bits == 16 else np.packbits(row > 0).tobytes() for row in rows]
    data = b"".join(b"\0" + line for line in lines)
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize(
    "data",
    [
        png((DISC * 255).astype(np.uint8)),
        png((DISC * 255).astype(np.uint8), "RGB"),
        png((DISC * 255).astype(np.uint8), "1"),
        png((DISC * 255).astype(np.uint8), "P"),
        png(rgba(0, DISC * 255)),  # black object on nothing: alpha decides
        png(rgba(255, DISC * 127)),  # the published masks
        png(rgba(DISC * 255, 255)),  # a mask saved with an opaque alpha channel: luminance decides
        png(np.where(DISC, 200, 7).astype(np.uint8), transparency=7),  # one grey declared transparent
        raw_png(DISC * 65535, 16),
        raw_png(DISC * 20000, 16),
        raw_png(DISC, 1),
    ],
)
def test_every_way_to_say_silhouette(data: bytes) -> None:
    silhouette = read_silhouette(data)
    assert silhouette.shape == (20, 30)
    assert np.array_equal(silhouette.numpy(), DISC.astype(np.float32))


def test_the_threshold_is_a_share_of_full_scale() -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (2, 1))
    assert int(read_silhouette(png(ramp))[0].sum()) == 255 - 63  # 64/255 is the first above 0.25
    assert int(read_silhouette(png(ramp), threshold=0.5)[0].sum()) == 128


@pytest.mark.parametrize(
    ("data", "error", "says"),
    [
        (b"", SilhouetteInvalid, "empty file"),
        (b"\xff\xd8\xff\xe0 JFIF", FormatUnsupported, "PNG"),
        (png(np.zeros((4, 4), np.uint8)), SilhouetteInvalid, "no pixel above"),
        (png(np.full((4, 4), 255, np.uint8)), SilhouetteInvalid, "background"),
        (
            png(rgba(DISC * 255, 0)),
            SilhouetteInvalid,
            "no pixel above",
        ),  # alpha decides
        (png((DISC * 255).astype(np.uint8))[:60], SilhouetteInvalid, "damaged PNG"),
        (png((DISC * 255).astype(np.uint8))[:20], SilhouetteInvalid, "truncated PNG"),
        (raw_png(np.zeros((1, 4097), int), 1), SilhouetteInvalid, "4097x1"),
    ],
)
def test_refused(data: bytes, error: type[InputError], says: str) -> None:
    with pytest.raises(error, match=says) as caught:
        read_silhouette(data)
    assert "\n" not in str(caught.value)


def test_a_huge_image_is_refused_by_its_header_alone() -> None:
    header = b"\x89PNG\r\n\x1a\n" + struct.pack(
        ">I4sIIBBBBBI", 13, b"IHDR", 100_000, 100_000, 8, 6, 0, 0, 0, 0
    )
    with pytest.raises(SilhouetteInvalid, match="at most 4096 pixels a side, got 100000x100000"):
        read_silhouette(header)


def test_flipped_bytes_give_an_input_error_or_an_image() -> None:
    dice = np.random.default_rng(0)
    data = png(rgba(0, DISC * 255))
    for _ in range(300):
        broken = bytearray(data)
        for at in dice.integers(8, len(data), 3):
            broken[at] = int(dice.integers(256))
        try:
            assert max(read_silhouette(bytes(broken)).shape) <= 4096
        except InputError:
            continue
