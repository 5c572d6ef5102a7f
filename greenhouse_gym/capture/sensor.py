"""Sensor models of depth cameras: stereo like the D435, and time of flight like the Azure Kinect.

Figures of the stereo camera: baseline 50 mm, disparity noise 0.08 px RMS, steps of 1/32 px, 1 mm depth units, an
invalid band as wide as the disparity, occlusion of the left imager, edge fattening, and some missing pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from greenhouse_gym.geometry import Array


@dataclass(frozen=True)
class StereoNoise:
    """Noise of the D435; every term can be set to zero."""

    baseline: float = 0.050  # m
    disparity_noise: float = 0.08  # px RMS
    disparity_step: float = 1 / 32  # px
    depth_unit: float = 0.001  # m
    bias: float = 0.002  # one sigma of the relative depth error of a camera
    dropout: float = 0.02  # fraction of pixels without a reading away from depth edges
    edge_dropout: float = 0.35  # fraction of pixels without a reading next to a depth edge
    edge_fattening: int = 1  # px by which foreground covers background at depth edges
    min_range: float = 0.17  # m
    max_range: float = 3.0  # m; farther readings are not modeled


@dataclass(frozen=True)
class StereoDropout:
    """Failures of block matching on plants, in addition to those at edges; every term can be set to zero.

    Wires of 2 mm before a far background give no depth (librealsense, issue 5477), surfaces have holes where they
    reflect the light (issues 4320 and 3744), and a poor exposure is the first reason for bad depth (Intel's notes on
    tuning the D400). None of these gives numbers: the figures here are priors.
    """

    thin_width: int = 5  # px; foreground narrower than this along an image row is thin
    thin_dropout: float = 0.25  # fraction of pixels without a reading on thin foreground
    mixed: float = 0.04  # fraction of pixels next to a depth edge whose reading lies between near and far
    glare_from: float = 0.12  # fraction of full white that a highlight must add to count as glare
    glare_dropout: float = 0.6  # fraction of pixels without a reading in glare
    burnt: int = 250  # gray level from which on all channels count as burnt out
    dark: int = 6  # gray level below which all channels count as black
    exposure_dropout: float = 0.5  # fraction of pixels without a reading where burnt out or black


def dropout_probability(
    depth: npt.NDArray[np.floating],
    color: npt.NDArray[np.uint8],
    glare: npt.NDArray[np.floating],
    fx: float,
    dropout: StereoDropout = StereoDropout(),
    baseline: float = StereoNoise.baseline,
) -> Array:
    """Return the probability (h, w) that stereo gives no reading: thin foreground, glare, failed exposure.

    ``depth`` (h, w) is the true one, metres, 0 or inf without a surface; ``color`` (h, w, 3) the photograph; ``glare``
    (h, w) the brightness that highlights add, as a fraction of full white; ``fx`` in pixels, ``baseline`` in metres.
    """
    true = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)
    lost = np.where(_thin(fx * baseline / true, dropout.thin_width), dropout.thin_dropout, 0.0)
    lost = np.maximum(lost, np.where(glare > dropout.glare_from, dropout.glare_dropout, 0.0))
    failed = (color >= dropout.burnt).all(axis=-1) | (color < dropout.dark).all(axis=-1)
    return np.asarray(np.maximum(lost, np.where(failed, dropout.exposure_dropout, 0.0)))


def mix_edges(depth: npt.NDArray[np.floating], rng: np.random.Generator, fraction: float) -> npt.NDArray[np.floating]:
    """Move a fraction of the pixels at edges along rows of a depth image (h, w) to a depth between near and far."""
    mixed = np.array(depth)
    left, right = depth[:, :-1], depth[:, 1:]
    with np.errstate(invalid="ignore"):
        edge = np.isfinite(left) & np.isfinite(right) & (np.abs(left - right) > 0.01)
    at = np.nonzero(edge & (rng.random(edge.shape) < fraction))
    part = rng.random(len(at[0]))
    mixed[at[0], at[1] + rng.integers(0, 2, len(part))] = (1 - part) * left[at] + part * right[at]
    return mixed


def draw_biases(count: int, rng: np.random.Generator, sigma: float) -> Array:
    """Sample the relative depth error of each of ``count`` cameras, (count,), normal with a given sigma."""
    return rng.normal(0.0, sigma, count)


def sense_depth(
    depth: npt.NDArray[np.floating],
    fx: float,
    rng: np.random.Generator,
    noise: StereoNoise = StereoNoise(),
    bias: float = 0.0,
    dropout: Array | float = 0.0,
) -> npt.NDArray[np.float32]:
    """Turn a true depth image into one that the camera would report.

    Args:
        depth: (height, width) true depth in metres; 0 or inf = no surface.
        fx: Focal length in pixels.
        rng: Source of the noise.
        noise: The camera's figures.
        bias: Relative depth error of this camera: it reports ``(1 + bias)`` times the depth.
        dropout: (height, width) additional probability of no reading, as from `dropout_probability`.

    Returns:
        (height, width) float32 metres, 0 = no reading.
    """
    true = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)
    for _ in range(noise.edge_fattening):
        true = _dilate_foreground(true)
    disparity = fx * noise.baseline / true  # 0 where there is no surface
    valid = (disparity > 0) & (true >= noise.min_range) & (true <= noise.max_range)
    valid &= ~_hidden_from_right_imager(disparity)
    edges = _near_edge(disparity)
    valid &= rng.random(depth.shape) >= np.maximum(np.where(edges, noise.edge_dropout, noise.dropout), dropout)
    disparity = disparity + smooth_noise(rng, depth.shape) * noise.disparity_noise
    if noise.disparity_step > 0:
        disparity = np.rint(disparity / noise.disparity_step) * noise.disparity_step
    valid &= disparity > 0
    measured = np.where(valid, fx * noise.baseline / np.where(valid, disparity, 1.0) * (1.0 + bias), 0.0)
    if noise.depth_unit > 0:
        measured = np.rint(measured / noise.depth_unit) * noise.depth_unit
    return measured.astype(np.float32)


def _dilate_foreground(depth: Array) -> Array:
    """Replace every pixel by the nearest depth of itself and its left and right neighbors."""
    dilated = depth.copy()
    dilated[:, 1:] = np.minimum(dilated[:, 1:], depth[:, :-1])
    dilated[:, :-1] = np.minimum(dilated[:, :-1], depth[:, 1:])
    return dilated


def _hidden_from_right_imager(disparity: Array) -> npt.NDArray[np.bool_]:
    """Mask pixels of the left image whose point lies outside the right image or behind nearer surfaces there."""
    columns = np.arange(disparity.shape[1])
    in_right = columns - disparity
    from_the_right = np.full_like(in_right, np.inf)
    from_the_right[:, :-1] = np.minimum.accumulate(in_right[:, :0:-1], axis=1)[:, ::-1]
    # a pixel further right that lands at or left of this one is nearer and covers it
    return (in_right < 0) | (from_the_right <= in_right - 0.5)


def _near_edge(disparity: Array) -> npt.NDArray[np.bool_]:
    """Mask pixels within 2 of a disparity step of more than one pixel."""
    edge = np.zeros(disparity.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(disparity, axis=axis)) > 1.0
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        edge[tuple(before)] |= step
        edge[tuple(after)] |= step
    wide = edge.copy()
    wide[:, 1:] |= edge[:, :-1]
    wide[:, :-1] |= edge[:, 1:]
    return wide


def _thin(disparity: Array, width: int) -> npt.NDArray[np.bool_]:
    """Mask foreground that is narrower than ``width`` along a row, nearer than the surfaces on both sides."""
    thin = np.zeros(disparity.shape, dtype=bool)
    for left in range(1, width):
        right = width - left
        step = disparity[:, left:-right] - np.maximum(disparity[:, :-width], disparity[:, width:])
        thin[:, left:-right] |= step > 1.0
    return thin


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Sample unit normal noise that is correlated between neighbors, as block matching makes it."""
    white = rng.standard_normal((shape[0] + 2, shape[1] + 2))
    rows = white[:-2] + white[1:-1] + white[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 3.0


@dataclass(frozen=True)
class TimeOfFlightNoise:
    """Errors of a time-of-flight camera; every term can be set to zero.

    Microsoft states a random error of up to 17 mm and a systematic one of up to 11 mm + 0.1 % of the distance, and no
    or wrong readings where the signal is weak and at edges. The defaults are priors within these limits; the noise is
    that of a real frame of an apple tree, about 1 mm on a leaf at 1.3 m.
    """

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
