"""How a stereo depth camera of the D435 kind spoils a perfect depth image. numpy only.

Figures: baseline 50 mm, disparity noise 0.08 px RMS, steps of 1/32 px, 1 mm depth units, an invalid band as wide as
the disparity, occlusion of the left imager, fattened edges, and some missing pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array


@dataclass(frozen=True)
class StereoNoise:
    """The D435's noise; every term can be set to zero."""

    baseline: float = 0.050  # m
    disparity_noise: float = 0.08  # px RMS
    disparity_step: float = 1 / 32  # px
    depth_unit: float = 0.001  # m
    bias: float = 0.002  # one sigma of the relative depth error of a camera
    dropout: float = 0.02  # share of pixels without a reading anywhere
    edge_dropout: float = 0.35  # share of pixels without a reading beside a depth edge
    fatten: int = 1  # px by which near things grow over far ones
    min_range: float = 0.17  # m
    max_range: float = 3.0  # m; farther readings are not modelled


def draw_biases(count: int, rng: np.random.Generator, noise: StereoNoise) -> Array:
    """Relative depth error of each of ``count`` cameras, (count,), normal with sigma ``noise.bias``."""
    return rng.normal(0.0, noise.bias, count)


def sense_depth(
    depth: npt.NDArray[np.floating],
    fx: float,
    rng: np.random.Generator,
    noise: StereoNoise = StereoNoise(),
    bias: float = 0.0,
) -> npt.NDArray[np.float32]:
    """What the camera reports for a true depth image.

    Args:
        depth: (height, width) true depth in metres; 0 or inf = nothing there.
        fx: Focal length in pixels.
        rng: Source of the noise.
        noise: The camera's figures.
        bias: This camera's relative depth error: it reports ``(1 + bias)`` times the depth.

    Returns:
        (height, width) float32 metres, 0 = no reading.
    """
    seen = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)
    for _ in range(noise.fatten):
        seen = _grow_near(seen)
    disparity = fx * noise.baseline / seen  # 0 where there is nothing
    valid = (disparity > 0) & (seen >= noise.min_range) & (seen <= noise.max_range)
    valid &= ~_hidden_from_right_imager(disparity)
    edges = _beside_edge(disparity)
    valid &= rng.random(depth.shape) >= np.where(edges, noise.edge_dropout, noise.dropout)
    disparity = disparity + _smooth_noise(rng, depth.shape) * noise.disparity_noise
    if noise.disparity_step > 0:
        disparity = np.rint(disparity / noise.disparity_step) * noise.disparity_step
    valid &= disparity > 0
    measured = np.where(valid, fx * noise.baseline / np.where(valid, disparity, 1.0) * (1.0 + bias), 0.0)
    if noise.depth_unit > 0:
        measured = np.rint(measured / noise.depth_unit) * noise.depth_unit
    return measured.astype(np.float32)


def _grow_near(depth: Array) -> Array:
    """Every pixel takes the nearest depth of itself and its left and right neighbours."""
    grown = depth.copy()
    grown[:, 1:] = np.minimum(grown[:, 1:], depth[:, :-1])
    grown[:, :-1] = np.minimum(grown[:, :-1], depth[:, 1:])
    return grown


def _hidden_from_right_imager(disparity: Array) -> npt.NDArray[np.bool_]:
    """Pixels of the left image whose point the right imager does not see: outside it, or behind something nearer."""
    columns = np.arange(disparity.shape[1])
    in_right = columns - disparity
    from_the_right = np.full_like(in_right, np.inf)
    from_the_right[:, :-1] = np.minimum.accumulate(in_right[:, :0:-1], axis=1)[:, ::-1]
    # a pixel further right that lands at or left of this one is nearer and covers it
    return (in_right < 0) | (from_the_right <= in_right - 0.5)


def _beside_edge(disparity: Array, jump: float = 1.0) -> npt.NDArray[np.bool_]:
    """Pixels within 2 of a disparity step of more than ``jump`` px."""
    edge = np.zeros(disparity.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(disparity, axis=axis)) > jump
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        edge[tuple(before)] |= step
        edge[tuple(after)] |= step
    wide = edge.copy()
    wide[:, 1:] |= edge[:, :-1]
    wide[:, :-1] |= edge[:, 1:]
    return wide


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Unit normal noise that neighbours partly share, as block matching makes it."""
    white = rng.standard_normal((shape[0] + 2, shape[1] + 2))
    rows = white[:-2] + white[1:-1] + white[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 3.0
