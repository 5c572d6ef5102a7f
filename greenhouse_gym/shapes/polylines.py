"""Polylines: few points instead of many."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from greenhouse_gym.geometry import Array, closest_on_segments

_WINDOW = 7  # points that are averaged


def smoothed(line: Array) -> Array:
    """The points (k, 3) of a line, each but the ends in the middle of its neighbors."""
    inner = ndimage.uniform_filter1d(line, _WINDOW, axis=0, mode="nearest")[1:-1]
    return np.concatenate([line[:1], inner, line[-1:]])


def fitted(line: Array, tolerance: float) -> Array:
    """Few points, where the lines between them fit the points (k, 3) of a line best.

    As many as of the line's own would stay within ``tolerance`` of it. A point on its way from one to the next is to
    lie where it lies on the line: hat functions of the length along the line, by linear least squares.
    """
    kept = kept_rows(line, tolerance)
    along = np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    hats = np.stack([np.interp(along, along[kept], hat) for hat in np.eye(len(kept))], axis=1)
    return np.asarray(np.linalg.lstsq(hats, line, rcond=None)[0])


def kept_rows(line: Array, tolerance: float) -> list[int]:
    """Rows of the fewest of a line's points (k, 3) that stay within ``tolerance`` of it (Douglas and Peucker 1973)."""
    if len(line) < 3:
        return list(range(len(line)))
    nearest = closest_on_segments(line, line[:1], line[-1:])[:, 0]
    off = np.linalg.norm(line - nearest, axis=1)
    worst = int(np.argmax(off))
    if off[worst] <= tolerance:
        return [0, len(line) - 1]
    return kept_rows(line[: worst + 1], tolerance)[:-1] + [worst + row for row in kept_rows(line[worst:], tolerance)]
