"""What colors and bends say of a cloud's points: which may be fruit, stem or pipe, and which can not.

Leaves are flat, and of one color over a row; gutters and strings are white. What bends like fruit or a stem may be one,
whatever its color, and so may what is redder than the leaves of the same cloud.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.settings import ShapeSettings

if TYPE_CHECKING:
    from greenhouse_gym.shapes.surfaces import SurfaceCloud

Mask = npt.NDArray[np.bool_]


def could_be_fruit(cloud: SurfaceCloud, settings: ShapeSettings) -> Mask:
    """Which points (n,) may be skin of a tomato, ripe or not: redder than leaves, or bulging both ways."""
    return is_colorful(cloud.colors, settings) & (
        _is_no_leaf(cloud, settings) | (cloud.bends[:, 0] > settings.fruit_bend)
    )


def could_be_stem(cloud: SurfaceCloud, settings: ShapeSettings) -> Mask:
    """Which points (n,) may lie on a main stem: redder than leaves, bulging one way at least, or long and thin."""
    stem = _is_no_leaf(cloud, settings) | (cloud.bends[:, 1] > settings.stem_bend)
    return is_colorful(cloud.colors, settings) & (stem | (cloud.lengths > settings.stem_length))


def could_be_pipe(cloud: SurfaceCloud, settings: ShapeSettings) -> Mask:
    """Which points (n,) may lie on a pipe: all but those of leaves."""
    return ~is_colorful(cloud.colors, settings) | _is_no_leaf(cloud, settings)


def is_colorful(colors: Array, settings: ShapeSettings) -> Mask:
    """Which colors (n, 3) are neither white, gray nor black, as strings and gutters are; all in a cloud without any."""
    colorful = _saturation(colors) > settings.least_saturation
    return colorful | ~colorful.any()


def redness(colors: Array) -> Array:
    """(R - G) / (R + G) of colors (n, 3), which ignores shading."""
    red, green = colors[:, 0], colors[:, 1]
    return np.asarray((red - green) / np.maximum(red + green, 1e-6))


def _is_no_leaf(cloud: SurfaceCloud, settings: ShapeSettings) -> Mask:
    """Which points (n,) are redder than the cloud's leaves."""
    return np.asarray(cloud.tones > cloud.leaf + max(settings.leaf_contrast, 2.5 * cloud.spread))


def _saturation(colors: Array) -> Array:
    return np.asarray(1.0 - colors.min(axis=1, initial=1.0) / np.maximum(colors.max(axis=1, initial=0.0), 1e-6))
