"""Joint paths: length, resampling, and timed commands that follow a path exactly.

A path is a polyline of configurations that was checked segment by segment, so the commands stay on it: along a segment
all joints move in proportion, with a trapezoidal speed profile (the time-optimal one under a limit on speed and
acceleration), and each corner is passed slowly enough that the arm, which lags behind its commands, cuts it by no more
than a tolerance. Forward and backward passes over the corners give their speeds (as in Kunz and Stilman, Time-Optimal
Trajectory Generation for Path Following with Bounded Acceleration and Velocity, 2012, without their blends).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

CORNER_TOLERANCE = 0.004
"""Largest error of any joint by which the lagging arm may cut a corner, radians."""

SERVO_LAG = 0.06
"""Lag of the arm behind its commands, seconds: the ratio of damping and stiffness of its servos."""


def path_length(path: npt.ArrayLike) -> float:
    """Return the Euclidean length of a path (k, n): radians for joint paths, metres for paths of points."""
    return float(np.linalg.norm(np.diff(np.asarray(path, dtype=np.float64), axis=0), axis=-1).sum())


def resample(path: npt.ArrayLike, step: float) -> Array:
    """Return points (m, n) on a path (k, n), its corners included, with neighbors at most a step apart.

    Args:
        path: The polyline.
        step: Largest difference of any coordinate between two neighbors.
    """
    points = np.asarray(path, dtype=np.float64)
    pieces = [points[:1]]
    for a, b in pairwise(points):
        count = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        pieces.append(a + (np.arange(1, count + 1) / count)[:, None] * (b - a))
    return np.concatenate(pieces)


def along_path(path: Array, reaches: Array, resolution: float) -> Array:
    """Return equally spaced configurations (m, n) on a path (k, n), between which no point of the arm moves far.

    Args:
        path: The polyline, radians.
        reaches: (n,) the arm's `greenhouse_gym.motion.joint_reaches.joint_reaches`.
        resolution: Largest motion of any point of the arm between two neighbors, metres.
    """
    position = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)) @ reaches)])
    samples = np.linspace(0.0, position[-1], 1 + int(np.ceil(position[-1] / resolution)))
    return np.stack([np.interp(samples, position, joint) for joint in path.T], axis=-1)


def follow_path(
    path: npt.ArrayLike,
    velocity_limits: npt.ArrayLike,
    acceleration_limits: npt.ArrayLike,
    interval: float,
    corner_tolerance: float = CORNER_TOLERANCE,
    lag: float = SERVO_LAG,
) -> Array:
    """Return commands at equal intervals that follow a path, from rest to rest.

    Args:
        path: (k, n) configurations, radians.
        velocity_limits: (n,) rad/s.
        acceleration_limits: (n,) rad/s^2.
        interval: Seconds from one command to the next.
        corner_tolerance: Largest error of any joint by which the arm may cut a corner, radians; above 0.
        lag: Lag of the arm behind its commands, seconds.

    Returns:
        (m, n) commands, all on the path; the last is its end. m = 0 for a path without length.

    Raises:
        InvalidValueError: A limit, the interval or the tolerance is not positive.
    """
    points = np.asarray(path, dtype=np.float64)
    speed = np.asarray(velocity_limits, dtype=np.float64)
    acceleration = np.asarray(acceleration_limits, dtype=np.float64)
    if not ((speed > 0).all() and (acceleration > 0).all() and interval > 0 and corner_tolerance > 0 and lag > 0):
        raise InvalidValueError("limits, interval, corner tolerance and lag must be positive")
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=-1)
    points = points[np.concatenate([[True], lengths > 0])]
    if len(points) < 2:
        return np.empty((0, points.shape[1]))
    steps, lengths = steps[lengths > 0], lengths[lengths > 0]
    directions = steps / lengths[:, None]
    magnitude = np.maximum(np.abs(directions), 1e-9)
    top_speeds = (speed / magnitude).min(-1)
    ramps = (acceleration / magnitude).min(-1)
    turns = np.abs(np.diff(directions, axis=0)).max(-1)
    corners = corner_tolerance / (lag * np.maximum(turns, 1e-9))
    nodes = np.concatenate([[0.0], np.minimum(corners, np.minimum(top_speeds[:-1], top_speeds[1:])), [0.0]])
    for i in range(len(lengths)):
        nodes[i + 1] = min(nodes[i + 1], np.sqrt(nodes[i] ** 2 + 2 * ramps[i] * lengths[i]))
    for i in reversed(range(len(lengths))):
        nodes[i] = min(nodes[i], np.sqrt(nodes[i + 1] ** 2 + 2 * ramps[i] * lengths[i]))
    return _sample(points[:-1], directions, lengths, nodes, top_speeds, ramps, interval)


def _sample(
    starts: Array, directions: Array, lengths: Array, nodes: Array, top_speeds: Array, ramps: Array, interval: float
) -> Array:
    """Sample positions at equal intervals; segments have trapezoidal speed profiles with given speeds at their ends."""
    first, last = nodes[:-1], nodes[1:]
    peaks = np.minimum(top_speeds, np.sqrt(ramps * lengths + (first**2 + last**2) / 2))
    rising, falling = (peaks - first) / ramps, (peaks - last) / ramps
    rise_lengths = (first + peaks) / 2 * rising
    cruise_lengths = np.maximum(lengths - rise_lengths - (peaks + last) / 2 * falling, 0.0)
    durations = rising + cruise_lengths / peaks + falling
    begins = np.concatenate([[0.0], np.cumsum(durations)])
    count = int(np.ceil(begins[-1] / interval - 1e-9))
    times = np.minimum(np.arange(1, count + 1) * interval, begins[-1])
    i = np.minimum(np.searchsorted(begins, times, side="right") - 1, len(lengths) - 1)
    t, left = times - begins[i], begins[i + 1] - times
    rise = first[i] * t + ramps[i] * t**2 / 2
    cruise = rise_lengths[i] + peaks[i] * (t - rising[i])
    fall = lengths[i] - last[i] * left - ramps[i] * left**2 / 2
    along = np.where(t < rising[i], rise, np.where(left > falling[i], cruise, fall))
    return np.asarray(starts[i] + np.clip(along, 0.0, lengths[i])[:, None] * directions[i])
