"""Color measures that do not depend on exposure."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array

_MIN_SATURATION = 0.15  # fruit and stems exceed this; gutters and strings are white


def colorful_mask(colors: Array) -> npt.NDArray[np.bool_]:
    """Return which colors (n, 3) are not white, gray or black; all of them if none is.

    Strings and gutters are white or gray.
    """
    saturation = 1.0 - colors.min(axis=1, initial=1.0) / np.maximum(colors.max(axis=1, initial=0.0), 1e-6)
    colorful = np.asarray(saturation > _MIN_SATURATION)
    return colorful | ~colorful.any()


def redness(colors: Array) -> Array:
    """Return (R - G) / (R + G) of colors (n, 3), which shading does not change."""
    red, green = colors[:, 0], colors[:, 1]
    return np.asarray((red - green) / np.maximum(red + green, 1e-6))
