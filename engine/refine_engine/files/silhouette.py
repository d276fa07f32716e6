"""The bytes of an image -> a silhouette: which pixels are the object, and of which nothing is known.

People draw masks in many levels and colours. What decides is looked for in this order: an alpha channel that
tells something; two levels, of which the brighter is the object; regions of several levels, which are labels;
else the image is soft, and the object begins half way up to its own largest level.
"""

from __future__ import annotations

import io
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from torch import Tensor

from refine_proto.formats import SILHOUETTE_THRESHOLD
from refine_proto.images import ImageFormat, ImageHeader, read_image_header

from ..errors import SilhouetteInvalid
from .limits import one_line, refused_as

Levels = NDArray[Any]  # (H, W)
Pixels = NDArray[np.bool_]  # (H, W)
BARELY_TRANSPARENT = 0.1  # an alpha channel that leaves out less may be an editor's, and the colours the mask
_MOST_LABELS = 16
_LABEL_WIDTH = 5  # pixels: a level that fills a square of it is no soft edge
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # by EXIF's orientation


class Silhouette(NamedTuple):
    """What an image says of the object."""

    coverage: Tensor  # (H, W) float32, 1 object, 0 background or unknown
    known: Tensor | None  # (H, W) bool; None: everywhere
    warnings: tuple[str, ...] = ()


def read_silhouette(
    data: bytes,
    threshold: float = SILHOUETTE_THRESHOLD,
    ignore_grey: int | None = None,
    ignore: bytes | None = None,
) -> Silhouette:
    """The silhouette in a PNG, JPEG, WebP, TIFF or BMP file, turned as its EXIF orientation says.

    Where an image has two levels only, the brighter is the object. Else it is what lies above `threshold` of
    the way from the image's smallest to its largest level. The alpha channel decides, if it tells the object
    from the background, else the brightest of the colour channels.

    Unknown are the pixels whose level, as the file stores it, is `ignore_grey`, and those that a second image
    of the same size, `ignore`, shows as an object.

    Raises FormatUnsupported or SilhouetteInvalid; the size is checked before anything is decoded.
    """
    image = _open(data)
    channel, warnings = _deciding_channel(image)
    unknown = np.zeros(channel.shape, bool)
    if ignore_grey is not None:
        unknown = _stored(image, channel) == ignore_grey
    if ignore is not None:
        unknown = unknown | _read_ignore(ignore, channel.shape)
    if unknown.all():
        raise SilhouetteInvalid(
            "expected pixels that are known, got a silhouette in which all are to be ignored"
        )
    covered, more = _object(channel, unknown, threshold)
    return Silhouette(
        torch.from_numpy(covered.astype(np.float32)),
        torch.from_numpy(~unknown) if unknown.any() else None,
        (*warnings, *more),
    )


def _read_ignore(data: bytes, shape: tuple[int, ...]) -> Pixels:
    """Where nothing is known: the object of an image; none if it has one level and that is black."""
    channel, _ = _deciding_channel(_open(data))
    if channel.shape != shape:
        raise SilhouetteInvalid(
            f"expected an ignore mask of the silhouette's size {shape[1]}x{shape[0]}, "
            f"got {channel.shape[1]}x{channel.shape[0]}"
        )
    if channel.min() == channel.max():
        return np.full(shape, channel.max() > 0)
    return _object(channel, np.zeros(shape, bool), SILHOUETTE_THRESHOLD)[0]


def _open(data: bytes) -> Image.Image:
    """The decoded image, as it is shown."""
    with refused_as(SilhouetteInvalid):
        header: ImageHeader = read_image_header(io.BytesIO(data))
    try:
        with Image.open(io.BytesIO(data), formats=[header.format]) as image:
            image.load()
            turn = None if header.format is ImageFormat.TIFF else _TURNS.get(header.orientation)  # Pillow has
            turned = image.copy() if turn is None else image.transpose(turn)
    except MemoryError:  # no fault of the file
        raise
    except Exception as error:  # a decoder may fail in any way on damaged bytes
        raise SilhouetteInvalid(f"damaged {header.format} file: {one_line(error)}") from error
    if turned.size != header.size:
        raise SilhouetteInvalid(f"damaged {header.format} file: {header.size} pixels became {turned.size}")
    return turned


def _deciding_channel(image: Image.Image) -> tuple[Levels, list[str]]:
    """Alpha, if it tells the object from the background, else the colours."""
    colour = _colour(image)
    if not image.has_transparency_data:
        return colour, []
    alpha = _alpha(image)
    clear = alpha <= alpha.max() / 2
    if alpha.min() == alpha.max() or not clear.any():
        return colour, []
    if clear.mean() <= BARELY_TRANSPARENT and _is_mask(colour[~clear]):
        told = (
            f"alpha leaves out only {clear.mean():.1%} of the picture and the colours are a mask: they decide"
        )
        return np.where(clear, colour.min(), colour), [told]
    return alpha, []


def _alpha(image: Image.Image) -> Levels:
    if image.mode.startswith("I"):  # 16 bits: one level is declared transparent
        return np.where(np.asarray(image) == image.info["transparency"], 0, 255)
    return np.asarray(image.convert("RGBA"))[..., 3]


def _colour(image: Image.Image) -> Levels:
    """The levels of a grey image as they are; of a coloured one what `_brightness` makes of it."""
    if image.mode in ("L", "F") or image.mode.startswith("I"):  # Pillow would clip 16 bits on conversion
        levels: Levels = np.nan_to_num(np.asarray(image))
        return levels
    if image.mode in ("1", "LA", "La"):
        return np.asarray(image.convert("L"))
    level = _brightness(np.asarray(image.convert("RGB")))
    if image.mode == "P" and level.min() == level.max():  # labels that have no colours
        return np.asarray(image)
    return level


def _brightness(rgb: NDArray[np.uint8]) -> Levels:
    """(H, W): the brightest channel, by which dark red is as good as grey. Where that is the same everywhere,
    or a picture has two colours, luminance."""
    red, green, blue = (rgb[..., i].astype(np.int32) for i in range(3))
    brightest: Levels = np.asarray(rgb.max(2))
    if (rgb == rgb[..., :1]).all():  # grey
        return brightest
    colour = red << 16 | green << 8 | blue
    two = _two_levels(colour)
    if not two and brightest.min() < brightest.max():
        return brightest
    luminance: Levels = 299 * red + 587 * green + 114 * blue
    return colour if two and luminance.min() == luminance.max() else luminance


def _stored(image: Image.Image, channel: Levels) -> Levels:
    """What `ignore_grey` speaks of: the index in an image with a palette, luminance in one with colours."""
    if image.mode == "P":
        return np.asarray(image)
    return np.asarray(image.convert("L")) if image.mode in ("RGB", "YCbCr", "CMYK") else channel


def _object(channel: Levels, unknown: Pixels, threshold: float) -> tuple[Pixels, list[str]]:
    """Which pixels (H, W) are the object, and what is odd about that."""
    known = channel[~unknown]
    low, high = known.min(), known.max()
    if low == high:
        raise SilhouetteInvalid(
            "expected an object and a background around it, got a silhouette with one level, "
            f"{low:g}, in all pixels{' that are known' if unknown.any() else ''}"
        )
    if _two_levels(known):
        return (channel == high) & ~unknown, []
    level = low + threshold * (float(high) - float(low))
    if labels := _labels(channel, unknown, level):
        told = ", ".join(f"{level:g}" for level in labels)
        return (channel > low) & ~unknown, [
            f"the silhouette has regions of several levels ({told}): all but {low:g} count as the object; "
            "ignore_grey leaves one out as unknown"
        ]
    return (channel > level) & ~unknown, []


def _two_levels(levels: Levels) -> bool:
    """Whether there are exactly two."""
    others = levels[levels != levels.flat[0]]
    return len(others) > 0 and bool((others == others[0]).all())


def _is_mask(levels: Levels) -> bool:
    """Whether levels (N,) are those of a mask: hardly any between the ends, and something at both."""
    low, high = float(levels.min()), float(levels.max())
    if low == high:
        return False
    share = (levels - low) / (high - low)
    ends = float((share < 0.1).mean()), float((share > 0.9).mean())
    return min(ends) > 0.001 and sum(ends) > 0.95


def _labels(channel: Levels, unknown: Pixels, enough: float) -> list[Any]:
    """The levels of a picture of labels, ascending; empty if no more than soft edges lie below `enough`."""
    levels = np.unique(channel[~unknown][:: max(1, channel.size // 2**16)])
    if not 2 < len(levels) <= _MOST_LABELS:
        return []
    levels = np.unique(channel[~unknown])
    between = (channel > levels[0]) & (channel <= enough) & ~unknown
    flat = ndimage.maximum_filter(channel, _LABEL_WIDTH) == ndimage.minimum_filter(channel, _LABEL_WIDTH)
    covers = (between & flat).sum() > 0.02 * (channel > levels[0]).sum()
    return levels.tolist() if covers and len(levels) <= _MOST_LABELS else []
