"""Polylines: few points instead of many."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array, closest_on_segments


def simplified(line: Array, tolerance: float) -> Array:
    """The fewest of a line's points (k, 3) that stay within ``tolerance`` of it (Douglas and Peucker 1973)."""
    if len(line) < 3:
        return line
    nearest = closest_on_segments(line, line[:1], line[-1:])[:, 0]
    off = np.linalg.norm(line - nearest, axis=1)
    worst = int(np.argmax(off))
    if off[worst] <= tolerance:
        return line[[0, -1]]
    return np.vstack([simplified(line[: worst + 1], tolerance)[:-1], simplified(line[worst:], tolerance)])
