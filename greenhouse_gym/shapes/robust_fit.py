"""Building blocks of fits: weights, least-squares steps, quantiles, and polylines through points."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from greenhouse_gym.geometry import Array, closest_on_segments

SCALES = (3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0)
"""Width of the weighted shell in each iteration of a fit, as a multiple of the final one."""

_WINDOW = 7  # points that are averaged


def tukey_weights(residual: Array, scale: float | Array) -> Array:
    """Return Tukey's biweight (Beaton and Tukey, 1974) of residuals: 1 for a residual of zero, 0 beyond ``scale``."""
    return np.asarray(np.clip(1 - (residual / scale) ** 2, 0.0, None) ** 2)


def gauss_newton_step(jacobian: Array, weight: Array, residual: Array, damping: Array) -> Array:
    """Return the parameter steps (..., k) that minimize the linearized weighted squares, for a batch of fits.

    Args:
        jacobian: (..., n, k) derivatives of the residuals.
        weight: (..., n) weights of the residuals.
        residual: (..., n) residuals.
        damping: (k,) damping of each parameter, as a fraction of the sum of the weights. A parameter that the points
            do not determine keeps its value.
    """
    transposed = jacobian.swapaxes(-1, -2)
    matrix = transposed @ (weight[..., None] * jacobian) + weight.sum(axis=-1)[..., None, None] * np.diag(damping)
    return np.asarray(np.linalg.solve(matrix, -transposed @ (weight * residual)[..., None])[..., 0])


def quantiles(values: Array, fractions: float | Array) -> Array:
    """Return numpy's quantiles of values (n, ...) along the first axis, in a tenth of the time for small n.

    Args:
        values: At least one value.
        fractions: One fraction, or (k,) of them.
    """
    ordered = np.sort(values, axis=0)
    position = np.asarray(fractions) * (len(values) - 1)
    below = position.astype(np.int64)
    low, high = ordered[below], ordered[np.minimum(below + 1, len(values) - 1)]
    part = (position - below).reshape(position.shape + (1,) * (values.ndim - 1))
    return np.asarray(low + part * (high - low))


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
