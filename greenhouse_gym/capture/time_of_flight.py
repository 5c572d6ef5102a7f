"""Sensor model of a time-of-flight depth camera like the Azure Kinect, for clouds unlike those of stereo cameras.

Microsoft states a random error of up to 17 mm and a systematic one of up to 11 mm + 0.1 % of the distance, and that
pixels with a weak signal and at edges have no or a wrong reading. The figures below are priors within these limits;
the noise is that of a real frame of an apple tree, about 1 mm on a leaf at 1.3 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from greenhouse_gym.capture.sensor import mix_edges, smooth_noise
from greenhouse_gym.geometry import Array


@dataclass(frozen=True)
class TimeOfFlightNoise:
    """Errors of a time-of-flight camera; every term can be set to zero."""

    noise: float = 0.0003  # m RMS on a white surface at 1 m; it grows with distance and darkness
    flying: float = 0.5  # fraction of the pixels at a depth edge whose reading lies between near and far
    multipath: float = 0.02  # weight of light that came by way of surfaces around a pixel, which rounds corners
    multipath_reach: float = 9.0  # px, one sigma
    min_signal: float = 0.03  # brightness over squared distance in m, below which there is no reading
    depth_unit: float = 0.001  # m
    bias: float = 0.003  # one sigma of the relative depth error of a camera
    max_range: float = 3.0  # m


def sense_time_of_flight(
    depth: npt.NDArray[np.floating],
    color: npt.NDArray[np.uint8],
    rng: np.random.Generator,
    noise: TimeOfFlightNoise = TimeOfFlightNoise(),
    bias: float = 0.0,
) -> npt.NDArray[np.float32]:
    """Turn a true depth image into one that a time-of-flight camera would report.

    Args:
        depth: (height, width) true depth in metres; 0 or inf = no surface.
        color: (height, width, 3) photograph, whose brightness stands for the reflectance.
        rng: Source of the noise.
        noise: The camera's figures.
        bias: Relative depth error of this camera.

    Returns:
        (height, width) float32 metres, 0 = no reading.
    """
    surface = np.isfinite(depth) & (depth > 0) & (depth <= noise.max_range)
    true = np.where(surface, depth, noise.max_range)
    signal = np.maximum(color.mean(axis=-1) / 255.0, 1e-3) / true**2
    mixed = mix_edges(mix_edges(true, rng, noise.flying).T, rng, noise.flying).T
    around = _mean_around(true, surface * signal, noise.multipath_reach)
    measured = (1 - noise.multipath) * mixed + noise.multipath * np.maximum(around, mixed)  # detours are longer
    measured += smooth_noise(rng, depth.shape) * noise.noise * true / np.sqrt(signal)
    measured *= 1.0 + bias
    if noise.depth_unit > 0:
        measured = np.rint(measured / noise.depth_unit) * noise.depth_unit
    return np.where(surface & (signal >= noise.min_signal), measured, 0.0).astype(np.float32)


def _mean_around(depth: Array, weight: Array, reach: float) -> Array:
    """Return the weighted Gaussian mean (h, w) of a depth image."""
    total = ndimage.gaussian_filter(weight, reach)
    return np.asarray(ndimage.gaussian_filter(depth * weight, reach) / np.maximum(total, 1e-9))
