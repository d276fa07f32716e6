"""The one colour scale of the confidences, from dark violet (0) over green to yellow (1): viridis.

Equal steps of the value look equally large, lightness rises all the way, and people who cannot tell red from
green read it too. Source: viridis of matplotlib (CC0), every eighth of its 256 colours; between them it is
linear, which is off by less than 2 of 255.
"""

from __future__ import annotations

import numpy as np

from .weld import Floats

VIRIDIS = bytes.fromhex("""
    440154 470d60 48186a 482374 472d7b 453781 424086 3e4989 3b528b 375b8d 33638d
    2f6b8e 2c728e 297a8e 26828e 23898e 21918c 1f978b 1f9f88 21a685 27ad81 31b57b
    3dbc74 4cc26c 5cc863 6ece58 81d34d 95d840 aadc32 c0df25 d5e21a eae51a fde725
""")
_KNOTS = np.frombuffer(VIRIDIS, np.uint8).reshape(-1, 3) / 255.0


def confidence_colours(confidence: Floats) -> Floats:
    """sRGB (..., 3) in [0, 1] of confidences (...); what is outside of 0 to 1 gets the colour of the end."""
    c = np.clip(confidence, 0.0, 1.0)
    at = np.linspace(0.0, 1.0, len(_KNOTS))
    return np.stack([np.interp(c, at, channel) for channel in _KNOTS.T], -1)


def linear_light(srgb: Floats) -> Floats:
    """sRGB in [0, 1] as linear values, which glTF's vertex colours are (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
