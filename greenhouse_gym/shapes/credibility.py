"""How credible a sphere is as a tomato: logistic regressions on its measures, fitted by benchmarks/fit_credibility.py."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array

ALONE = np.array(
    [
        15.48,
        -11.45,
        -2.784,
        1.865,
        52.33,
        -7.316,
        -2.676,
        5.273,
        -0.4634,
        -1.357,
        5.674,
        1.583,
        2.837,
        -0.6135,
        0.1803,
        1.311,
        -46.89,
    ]
)
"""Weights of `candidates.MEASURES`, and the offset."""

IN_ROW = np.array(
    [
        10.89,
        -10.75,
        -2.061,
        0.9949,
        34.75,
        -5.089,
        -2.032,
        3.168,
        0.2607,
        -0.2124,
        5.416,
        1.009,
        2.457,
        -0.555,
        0.06415,
        0.9091,
        -2.543,
        0.7367,
        -5.05,
        0.4546,
        -0.1035,
        -0.2312,
        -29.71,
    ]
)
"""Weights of `candidates.MEASURES` and `candidates.COMPANY` for spheres of the first look, and the offset."""

BESIDE = np.array(
    [
        6.906,
        5.971,
        0.2582,
        -1.991,
        2.574,
        -0.6021,
        -1.029,
        -0.5864,
        -0.251,
        -0.4601,
        0.218,
        0.04243,
        1.193,
        0.2884,
        -0.225,
        -0.8248,
        1.317,
        -1.174,
        -0.3232,
        1.341,
        -0.1199,
        -1.602,
        -4.94,
    ]
)
"""Likewise for spheres of the second look, beside others that are sure."""


def credibility(measures: Array, weights: Array) -> Array:
    """How likely spheres are tomatoes, 0 to 1 (k,), by their measures (k, m) and the weights (m + 1,) of these."""
    return np.asarray(1 / (1 + np.exp(-np.clip(measures @ weights[:-1] + weights[-1], -30.0, 30.0))))
