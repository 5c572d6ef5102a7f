"""What colors say: leaves are bluish green, gutters and strings are white; fruit and stems are neither."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.settings import ShapeSettings


def could_be_fruit_or_stem(colors: Array, settings: ShapeSettings) -> npt.NDArray[np.bool_]:
    """Which colors (n, 3) a tomato, ripe or not, or a stem may have; all of them in a cloud without colors."""
    colorful = _saturation(colors) > settings.least_saturation
    if not colorful.any():
        return np.ones(len(colors), dtype=bool)
    return colorful & (redness(colors) > settings.least_redness)


def could_be_peduncle(colors: Array, settings: ShapeSettings) -> npt.NDArray[np.bool_]:
    """Which colors (n, 3) a peduncle may have: those of stems, but not of ripe fruit; all in a cloud without colors."""
    return could_be_fruit_or_stem(colors, settings) & (redness(colors) < settings.most_redness)


def is_colorless(colors: Array, settings: ShapeSettings) -> npt.NDArray[np.bool_]:
    """Which colors (n, 3) are white, gray or black: those of strings and gutters; none in a cloud without colors."""
    pale = _saturation(colors) <= settings.least_saturation
    return pale & (not pale.all())


def could_be_pipe(colors: Array, settings: ShapeSettings) -> npt.NDArray[np.bool_]:
    """Which colors (n, 3) a pipe may have: all but those of leaves."""
    return (_saturation(colors) <= settings.least_saturation) | (redness(colors) > settings.least_redness)


def redness(colors: Array) -> Array:
    """(R - G) / (R + G) of colors (n, 3), which ignores shading."""
    red, green = colors[:, 0], colors[:, 1]
    return np.asarray((red - green) / np.maximum(red + green, 1e-6))


def _saturation(colors: Array) -> Array:
    return np.asarray(1.0 - colors.min(axis=1, initial=1.0) / np.maximum(colors.max(axis=1, initial=0.0), 1e-6))
