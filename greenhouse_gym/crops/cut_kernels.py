"""Choice of the box around a piece of a leaf, and of the cut through it, compiled."""

from __future__ import annotations

import math

import numpy as np

from greenhouse_gym.common.jit import allocating, kernel
from greenhouse_gym.geometry import Array


@allocating
def _volume(points, beyond, side, angles, tolerance, deep):
    """Return the volume of the box around the points on one side of a cut, with the tolerance added to its depth."""
    middle, moments, apart = np.zeros(3), np.zeros((3, 3)), np.empty(3)
    count = 0
    for i in range(len(points)):
        if beyond[i] == side:
            count += 1
            for k in range(3):
                middle[k] += points[i, k]
    middle /= count
    for i in range(len(points)):
        if beyond[i] == side:
            for k in range(3):
                apart[k] = points[i, k] - middle[k]
            for k in range(3):
                for j in range(3):
                    moments[k, j] += apart[k] * apart[j]
    axes = np.linalg.eigh(moments)[1]
    half = np.empty(3)
    best = np.inf
    low, high = np.empty((len(angles), 2)), np.empty((len(angles), 2))
    low[:], high[:] = np.inf, -np.inf
    lowest, highest = np.inf, -np.inf
    for i in range(len(points)):
        if beyond[i] == side:
            u, v, w = 0.0, 0.0, 0.0
            for k in range(3):
                apart[k] = points[i, k] - middle[k]
                u += apart[k] * axes[k, 2]
                v += apart[k] * axes[k, 1]
                w += apart[k] * axes[k, 0]
            lowest, highest = min(lowest, w), max(highest, w)
            for a in range(len(angles)):
                x, y = angles[a, 0] * u + angles[a, 1] * v, angles[a, 0] * v - angles[a, 1] * u
                low[a, 0], high[a, 0] = min(low[a, 0], x), max(high[a, 0], x)
                low[a, 1], high[a, 1] = min(low[a, 1], y), max(high[a, 1], y)
    for a in range(len(angles)):
        area = (high[a, 0] - low[a, 0]) * (high[a, 1] - low[a, 1])
        if area < best:
            best = area
            half[0], half[1] = (high[a, 0] - low[a, 0]) / 2, (high[a, 1] - low[a, 1]) / 2
    half[2] = (highest - lowest) / 2
    return max(half[0], deep) * max(half[1], deep) * (2 * max(half[2], deep) + tolerance)


@kernel("Tuple((i8, f8))(f8[:,::1], f8[::1], f8[::1], f8[:,::1], f8, f8)")
def best_cut(
    points: Array, half_extents: Array, cuts: Array, angles: Array, tolerance: float, min_half: float
) -> tuple[int, float]:
    """Return axis and position of the cut of a piece that minimizes the boxes around both parts.

    Args:
        points: (n, 3) points of the piece in the frame of its box.
        half_extents: (3,) of the box; only its longer two sides are cut.
        cuts: (k,) positions to try, in half extents.
        angles: (a, 2) cosines and sines of the directions of the longer sides of the boxes around the parts.
        tolerance: Distance added to the depth of a box; sides of that length or less are not cut.
        min_half: Smallest half extent of a box.
    """
    axis, position, best = int(np.argmax(half_extents)), 0.0, math.inf
    beyond = np.empty(len(points), dtype=np.bool_)
    for k in range(2):
        if half_extents[k] <= tolerance / 2:
            continue
        for cut in cuts:
            at, count = half_extents[k] * cut, 0
            for i in range(len(points)):
                beyond[i] = points[i, k] > at
                count += beyond[i]
            if 0 < count < len(points):
                volume = _volume(points, beyond, True, angles, tolerance, min_half)
                volume += _volume(points, beyond, False, angles, tolerance, min_half)
                if volume < best:
                    axis, position, best = k, at, volume
    return axis, position


@kernel("i8(f8[:,::1], f8[:,::1])")
def smallest_rectangle(x: Array, y: Array) -> int:
    """Return the index of the frame in which the bounding rectangle of points is smallest.

    Args:
        x: (n, k) coordinates of n points along one side, in k frames.
        y: (n, k) coordinates along the other side.
    """
    low_x, high_x, low_y, high_y = x[0].copy(), x[0].copy(), y[0].copy(), y[0].copy()
    for i in range(1, len(x)):
        for k in range(x.shape[1]):
            low_x[k], high_x[k] = min(low_x[k], x[i, k]), max(high_x[k], x[i, k])
            low_y[k], high_y[k] = min(low_y[k], y[i, k]), max(high_y[k], y[i, k])
    return int(np.argmin((high_x - low_x) * (high_y - low_y)))
