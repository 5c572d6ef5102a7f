"""Smoothing and simplification of polylines."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from greenhouse_gym.geometry import Array, closest_on_segments

_WINDOW = 7  # points that are averaged


def smooth_polyline(line: Array) -> Array:
    """Return a polyline (k, 3) with each point but the ends averaged over its neighbors."""
    inner = ndimage.uniform_filter1d(line, _WINDOW, axis=0, mode="nearest")[1:-1]
    return np.concatenate([line[:1], inner, line[-1:]])


def fit_polyline(line: Array, tolerance: float) -> Array:
    """Return the polyline that fits the points (k, 3) of a line best, with the knots that `simplify_polyline` needs.

    A linear least-squares fit with hat functions of the length along the line.
    """
    kept = simplify_polyline(line, tolerance)
    along = np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    hats = np.stack([np.interp(along, along[kept], hat) for hat in np.eye(len(kept))], axis=1)
    return np.asarray(np.linalg.lstsq(hats, line, rcond=None)[0])


def simplify_polyline(line: Array, tolerance: float) -> list[int]:
    """Return the rows of a line (k, 3) whose polyline stays within ``tolerance`` of it (Douglas and Peucker 1973)."""
    if len(line) < 3:
        return list(range(len(line)))
    nearest = closest_on_segments(line, line[:1], line[-1:])[:, 0]
    off = np.linalg.norm(line - nearest, axis=1)
    worst = int(np.argmax(off))
    if off[worst] <= tolerance:
        return [0, len(line) - 1]
    head, tail = simplify_polyline(line[: worst + 1], tolerance), simplify_polyline(line[worst:], tolerance)
    return head[:-1] + [worst + row for row in tail]
