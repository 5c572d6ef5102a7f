"""Building blocks of robust fits: weights, least-squares steps and quantiles."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array

SCALES = (3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0)
"""Width of the weighted shell in each iteration of a fit, as a multiple of the final one."""


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
