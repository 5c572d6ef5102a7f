"""What robust fits share: weights, a step of least squares, quantiles."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array

SCALES = (3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0)
"""The shell within which points count in each iteration of a fit, as a multiple of the last one's."""


def tukey_weights(residual: Array, scale: float | Array) -> Array:
    """Tukey's biweight (Beaton and Tukey, 1974) of residuals: 1 where there is none, 0 beyond ``scale``."""
    return np.asarray(np.clip(1 - (residual / scale) ** 2, 0.0, None) ** 2)


def gauss_newton_step(jacobian: Array, weight: Array, residual: Array, damping: Array) -> Array:
    """Change (..., k) of the parameters that reduces the weighted squares of the residuals most, of any number of fits.

    Args:
        jacobian: (..., n, k) derivatives of the residuals.
        weight: (..., n) weights of the residuals.
        residual: (..., n) what is to become small.
        damping: (k,) how much each parameter is held, as a share of the sum of the weights: a parameter of which the
            points tell nothing stays as it is.
    """
    transposed = jacobian.swapaxes(-1, -2)
    matrix = transposed @ (weight[..., None] * jacobian) + weight.sum(axis=-1)[..., None, None] * np.diag(damping)
    return np.asarray(np.linalg.solve(matrix, -transposed @ (weight * residual)[..., None])[..., 0])


def quantiles(values: Array, shares: float | Array) -> Array:
    """Quantiles along the first axis of values (n, ...) like numpy's, but in a tenth of the time where n is small.

    Args:
        values: At least one.
        shares: One share, or (k,) of them.
    """
    ordered = np.sort(values, axis=0)
    place = np.asarray(shares) * (len(values) - 1)
    below = place.astype(np.int64)
    low, high = ordered[below], ordered[np.minimum(below + 1, len(values) - 1)]
    part = (place - below).reshape(place.shape + (1,) * (values.ndim - 1))
    return np.asarray(low + part * (high - low))
