from __future__ import annotations

import matplotlib
import numpy as np

from refine_engine.files.colour_scale import confidence_colours, linear_light

VALUES = np.linspace(0, 1, 256)


def test_it_is_viridis() -> None:
    expected = matplotlib.colormaps["viridis"](VALUES)[:, :3]
    assert abs(confidence_colours(VALUES) - expected).max() < 2 / 255


def test_lightness_rises_all_the_way() -> None:
    luminance = linear_light(confidence_colours(VALUES)) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0).all()


def test_values_outside_get_the_colours_of_the_ends() -> None:
    inside, outside = confidence_colours(np.array([0.0, 1.0])), confidence_colours(np.array([-0.5, 1.5]))
    assert np.array_equal(inside, outside)


def test_linear_light_is_that_of_srgb() -> None:
    assert np.allclose(linear_light(np.array([0.0, 0.04, 0.5, 1.0])), [0, 0.0030960, 0.2140411, 1], atol=1e-6)
