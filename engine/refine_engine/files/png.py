"""PNG bytes -> silhouette."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from refine_proto.formats import SILHOUETTE_THRESHOLD, png_size

from ..errors import SilhouetteInvalid
from .limits import one_line, refused_as


def read_silhouette(data: bytes, threshold: float = SILHOUETTE_THRESHOLD) -> Tensor:
    """The silhouette (H, W) float32, 1 where the image is above `threshold` (of full scale), else 0.

    The image's alpha channel decides if it has one, else its luminance. An alpha channel that is opaque
    everywhere says nothing about the object, and editors add one to a white-on-black mask when they save it,
    so then too the luminance decides.

    PNG only, of any bit depth, at most MAX_IMAGE_SIDE pixels a side (checked before anything is decoded).
    Raises FormatUnsupported or SilhouetteInvalid.
    """
    with refused_as(SilhouetteInvalid):
        png_size(data)
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            level = _level(image)
    except MemoryError:  # no fault of the file
        raise
    except Exception as error:  # a decoder may fail in any way on damaged bytes
        raise SilhouetteInvalid(f"damaged PNG file: {one_line(error)}") from error
    silhouette = level > threshold
    if not silhouette.any():
        raise SilhouetteInvalid(
            f"expected an object in the silhouette, got no pixel above the threshold {threshold:g} "
            f"(the largest is {level.max():.3f})"
        )
    if silhouette.all():
        raise SilhouetteInvalid(
            f"expected background around the object, got a silhouette with every pixel above the "
            f"threshold {threshold:g}"
        )
    return torch.from_numpy(silhouette.astype(np.float32))


def _level(image: Image.Image) -> NDArray[np.floating[Any]]:
    """Alpha or luminance (H, W) from 0 to 1."""
    if image.has_transparency_data:
        rgba = np.asarray(image.convert("RGBA"))
        alpha = rgba[..., 3]
        if alpha.min() < 255:
            return alpha.astype(np.float32) / 255
        image = image.convert("RGB")
    if image.mode.startswith("I"):  # 16 bits; Pillow's own conversion to 8 would clip them
        return np.asarray(image).astype(np.float32) / 65535
    return np.asarray(image.convert("L")).astype(np.float32) / 255
