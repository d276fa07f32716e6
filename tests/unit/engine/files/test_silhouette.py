from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from refine_engine.errors import FormatUnsupported, InputError, SilhouetteInvalid
from refine_engine.files.silhouette import read_silhouette

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
    silhouette = read_silhouette(data).coverage
    assert silhouette.shape == (20, 30)
    assert np.array_equal(silhouette.numpy(), DISC.astype(np.float32))


def test_soft_edges_begin_at_a_share_of_the_images_own_levels() -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (2, 1))
    assert int(read_silhouette(png(ramp)).coverage[0].sum()) == 128
    assert int(read_silhouette(png(ramp // 2)).coverage[0].sum()) == 128  # as dark as the published masks
    assert int(read_silhouette(png(ramp), threshold=0.25).coverage[0].sum()) == 255 - 63


@pytest.mark.parametrize(
    ("data", "error", "says"),
    [
        (b"", SilhouetteInvalid, "empty file"),
        (b"GIF89a", FormatUnsupported, "got a GIF file; convert it to PNG"),
        (png(np.zeros((4, 4), np.uint8)), SilhouetteInvalid, "one level, 0, in all pixels"),
        (png(np.full((4, 4), 255, np.uint8)), SilhouetteInvalid, "one level, 255, in all pixels"),
        (png(rgba(7, 255)), SilhouetteInvalid, "one level, 7, in all pixels"),
        (png((DISC * 255).astype(np.uint8))[:60], SilhouetteInvalid, "damaged PNG file"),
        (png((DISC * 255).astype(np.uint8))[:20], SilhouetteInvalid, "truncated PNG file"),
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
            assert max(read_silhouette(bytes(broken)).coverage.shape) <= 4096
        except InputError:
            continue


def encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


def palette(*colours: tuple[int, int, int]) -> bytes:
    """An image of two indices, which have these colours."""
    image = Image.fromarray(DISC.astype(np.uint8), "P")
    image.putpalette([x for colour in colours for x in colour])
    return encoded(image, "PNG")


def coloured(background: tuple[int, int, int], on_disc: tuple[int, int, int]) -> bytes:
    return png(np.where(DISC[..., None], on_disc, background).astype(np.uint8))


@pytest.mark.parametrize(
    "data",
    [
        png(DISC.astype(np.uint8)),  # labels 0 and 1
        png((DISC * 15 + 200).astype(np.uint8)),  # two levels, and both bright
        raw_png(DISC * 255, 16),
        raw_png(DISC * 1, 16),
        palette((0, 0, 0), (128, 0, 0)),  # VOC
        palette((0, 0, 0), (0, 0, 255)),
        palette((0, 0, 0), (1, 1, 1)),
        palette((255, 255, 0), (255, 255, 255)),
        coloured((0, 0, 0), (0, 0, 255)),
        coloured((0, 0, 255), (255, 255, 255)),
        coloured((255, 0, 0), (0, 255, 0)),
        coloured((200, 0, 0), (0, 200, 30)),
        png(rgba(255, DISC * 3)),
        encoded(Image.fromarray(DISC.astype(np.float32)), "TIFF"),
        encoded(Image.fromarray((DISC * 70_000).astype(np.int32)), "TIFF"),
        encoded(Image.fromarray(DISC), "TIFF", compression="group4"),
        encoded(Image.fromarray((DISC * 9).astype(np.uint8)), "BMP"),
        encoded(Image.fromarray(rgba(0, DISC * 255)), "WEBP", lossless=True),
        encoded(Image.fromarray((DISC * 250).astype(np.uint8)), "WEBP", lossless=True),
    ],
)
def test_of_two_levels_the_brighter_is_the_object(data: bytes) -> None:
    read = read_silhouette(data)
    assert np.array_equal(read.coverage.numpy(), DISC)
    assert (read.known, read.warnings) == (None, ())


LUMINANCE = np.array([299, 587, 114])
colours = st.tuples(*(st.integers(0, 255) for _ in range(3)))


@given(one=colours, other=colours)
def test_any_two_colours_are_a_mask(one: tuple[int, int, int], other: tuple[int, int, int]) -> None:
    assume(one != other)
    dark, bright = sorted((one, other), key=lambda colour: (int(LUMINANCE @ colour), colour))
    assert np.array_equal(read_silhouette(coloured(dark, bright)).coverage.numpy(), DISC)
    assert np.array_equal(read_silhouette(palette(dark, bright)).coverage.numpy(), DISC)


@given(
    levels=st.tuples(st.integers(0, 65_535), st.integers(0, 65_535)).filter(lambda pair: pair[0] != pair[1])
)
def test_any_two_levels_are_a_mask(levels: tuple[int, int]) -> None:
    low, high = sorted(levels)
    assert np.array_equal(read_silhouette(raw_png(np.where(DISC, high, low), 16)).coverage.numpy(), DISC)


@given(levels=st.lists(st.integers(0, 65_535), min_size=3, max_size=3, unique=True))
def test_the_ignored_level_leaves_two(levels: list[int]) -> None:
    unknown, low, high = levels[0], *sorted(levels[1:])
    picture = np.where(DISC, high, low)
    picture[:, 14:] = unknown
    read = read_silhouette(raw_png(picture, 16), ignore_grey=unknown)
    assert read.known is not None
    assert not read.known[:, 14:].any()
    assert read.known[:, :14].all()
    assert np.array_equal(read.coverage.numpy()[:, :14], DISC[:, :14])


@pytest.mark.parametrize("kind", ["JPEG", "WEBP"])
def test_lossy_masks(kind: str) -> None:
    large = np.kron(DISC, np.ones((8, 8), bool))
    coverage = read_silhouette(encoded(Image.fromarray((large * 255).astype(np.uint8)), kind)).coverage
    assert (coverage.numpy() != large).mean() < 0.01


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "TIFF"])
def test_an_image_is_read_as_its_orientation_shows_it(kind: str, orientation: int) -> None:
    picture = np.zeros((32, 48), np.uint8)
    picture[4:12, 8:32] = 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encoded(Image.fromarray(picture), kind, exif=exif)
    with Image.open(io.BytesIO(data)) as image:
        shown = np.asarray(ImageOps.exif_transpose(image).convert("L")) > 127
    assert np.array_equal(read_silhouette(data).coverage.numpy(), shown)


MARGIN = np.pad(np.full((19, 29), 255, np.uint8), [(1, 0), (0, 1)])  # a row and a column are transparent


@pytest.mark.parametrize(
    ("alpha", "warned"),
    [
        (0, False),
        (200, False),
        (np.where(DISC.cumsum().reshape(DISC.shape) == 1, 254, 255), False),
        (MARGIN, True),
    ],
)
def test_alpha_that_decides_nothing_gives_way_to_the_colours(alpha: Any, warned: bool) -> None:
    small = DISC & (MARGIN > 0)
    read = read_silhouette(png(rgba(small * 255, alpha)))
    assert np.array_equal(read.coverage.numpy(), small)
    assert [warning.startswith("alpha leaves out only") for warning in read.warnings] == [True] * warned


def test_alpha_around_a_photograph_decides_however_much_it_covers() -> None:
    photograph = np.random.default_rng(0).integers(0, 255, DISC.shape)
    assert np.array_equal(read_silhouette(png(rgba(photograph, MARGIN))).coverage.numpy(), MARGIN > 0)


LABELS = (DISC * 15).astype(np.uint8)
LABELS[:, 20:] = 255  # what a data set calls void


def test_labels_are_the_object_but_for_the_background_and_that_is_said() -> None:
    read = read_silhouette(png(LABELS))
    assert np.array_equal(read.coverage.numpy(), LABELS > 0)
    assert "several levels (0, 15, 255): all but 0 count as the object; ignore_grey" in read.warnings[0]


def in_palette(colours: list[int]) -> bytes:
    """LABELS as indices into these colours."""
    image = Image.fromarray(LABELS, "P")
    image.putpalette(colours)
    return encoded(image, "PNG")


@pytest.mark.parametrize(
    "data",
    [
        png(LABELS),
        raw_png(LABELS.astype(int), 16),
        in_palette([0, 0, 0] * 15 + [0, 0, 64] + [0, 0, 0] * 239 + [224, 224, 192]),
        in_palette([0] * 768),
        png(np.dstack([LABELS] * 3)),
        png(rgba(0, LABELS)),
    ],
)
def test_pixels_of_the_ignored_level_are_unknown(data: bytes) -> None:
    read = read_silhouette(data, ignore_grey=255)
    assert read.known is not None
    assert np.array_equal(read.known.numpy(), LABELS < 255)
    assert np.array_equal(read.coverage.numpy(), LABELS == 15)
    assert read.warnings == ()


def test_what_a_second_image_shows_is_unknown() -> None:
    hidden = np.zeros(DISC.shape, bool)
    hidden[:, 10:] = True
    read = read_silhouette(png((DISC * 255).astype(np.uint8)), ignore=png(hidden.astype(np.uint8)))
    assert read.known is not None
    assert np.array_equal(read.known.numpy(), ~hidden)
    assert np.array_equal(read.coverage.numpy(), DISC & ~hidden)
    nothing = read_silhouette(png((DISC * 255).astype(np.uint8)), ignore=png(0 * LABELS))
    assert nothing.known is None


@pytest.mark.parametrize(
    ("ignore", "says"),
    [
        (np.zeros((20, 29), np.uint8), "ignore mask of the silhouette's size 30x20, got 29x20"),
        (np.ones((20, 30), np.uint8), "expected pixels that are known"),
        ((~DISC).astype(np.uint8), "one level, 255, in all pixels that are known"),
    ],
)
def test_ignore_masks_that_are_refused(ignore: Any, says: str) -> None:
    with pytest.raises(SilhouetteInvalid, match=says):
        read_silhouette(png((DISC * 255).astype(np.uint8)), ignore=png(ignore))
