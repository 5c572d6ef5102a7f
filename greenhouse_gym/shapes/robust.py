"""One step of a robust least-squares fit, which spheres, pipes and stems share."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array

SCALES = (3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0)
"""The shell within which points count in each iteration of a fit, as a multiple of the last one's."""


def tukey_weights(residual: Array, scale: float) -> Array:
    """Tukey's biweight (Beaton and Tukey, 1974) of residuals (n,): 1 where there is none, 0 beyond ``scale``."""
    return np.asarray(np.clip(1 - (residual / scale) ** 2, 0.0, None) ** 2)


def gauss_newton_step(jacobian: Array, weight: Array, residual: Array, damping: Array) -> Array:
    """Change (k,) of the parameters that reduces the weighted squares of the residuals most.

    Args:
        jacobian: (n, k) derivatives of the residuals.
        weight: (n,) weights of the residuals.
        residual: (n,) what is to become small.
        damping: (k,) how much each parameter is held, as a share of the sum of the weights: a parameter of which the
            points tell nothing stays as it is.
    """
    matrix = jacobian.T @ (weight[:, None] * jacobian) + weight.sum() * np.diag(damping)
    return np.asarray(np.linalg.solve(matrix, -jacobian.T @ (weight * residual)))
