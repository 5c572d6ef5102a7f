"""How credible a sphere is as a tomato: logistic regressions on its measures, fitted by benchmarks/fit_credibility.py."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array

ALONE = np.zeros(17)
IN_ROW = np.zeros(23)
BESIDE = np.zeros(23)


def credibility(measures: Array, weights: Array) -> Array:
    """How likely spheres are tomatoes, 0 to 1 (k,), by their measures (k, m) and the weights (m + 1,) of these."""
    return np.asarray(1 / (1 + np.exp(-np.clip(measures @ weights[:-1] + weights[-1], -30.0, 30.0))))
