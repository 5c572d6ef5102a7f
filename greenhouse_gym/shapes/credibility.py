"""How credible a sphere is as a tomato: the mean of logistic regressions and of networks that are told more.

training/shape_networks.py fits the regressions, and training/shape_networks.py the networks, to rows of plants.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.networks import network

Judge = Callable[[Array], Array]
"""Says how likely spheres are fruit, 0 to 1 (k,), by their measures (k, m)."""

ALONE = np.array([
    12.54, -12.55, -1.977, 1.232, 55.67, -4.928, -2.524, 5.869, -1.454, -2.269, 5.039, 2.666, 9.603, 0.4137,
    0.8649, 2.43, 1.074, -55.88,
])  # fmt: skip
"""Weights of `candidates.MEASURES`, and the offset."""

IN_ROW = np.array([
    8.842, -12.19, -1.725, 0.8673, 33.56, -3.755, -2.227, 3.86, -0.3139, -1.537, 5.216, 2.584, 8.67, 0.01216,
    -0.01269, 2.306, 1.209, -1.749, -0.1237, -4.176, 1.029, 0.08618, -0.2067, -34.66,
])  # fmt: skip
"""Weights of `candidates.MEASURES` and `candidates.COMPANY` for spheres of the first look, and the offset."""

BESIDE = np.array([
    8.507, 8.044, 0.1609, -2.289, 2.605, -0.5358, -1.057, -0.4775, -0.6429, -0.5045, 0.3081, 0.3803, 3.79,
    0.6909, -0.773, 0.02517, -0.4492, -1.034, -1.841, -6.552, 0.5026, -0.5502, -0.6841, -1.945,
])  # fmt: skip
"""Such weights for spheres of the second look, beside others that are sure."""


class Judges(NamedTuple):
    """Who judges, beside the regressions, spheres of the first look and of the second."""

    first: Judge
    second: Judge


def shipped_judges() -> Judges:
    """The networks that are shipped."""
    return Judges(network("large_fruit"), network("large_fruit_beside"))


def judged(measures: Array, weights: Array, judge: Judge) -> Array:
    """How credible spheres are (k,), by all of their measures (k, m).

    Args:
        measures: Begin with those that the weights are of.
        weights: Of a regression.
        judge: Whose judgement counts as much.
    """
    return (credibility(measures[:, : len(weights) - 1], weights) + judge(measures)) / 2


def credibility(measures: Array, weights: Array) -> Array:
    """How likely spheres are tomatoes, 0 to 1 (k,), by their measures (k, m) and the weights (m + 1,) of these."""
    return np.asarray(1 / (1 + np.exp(-np.clip(measures @ weights[:-1] + weights[-1], -30.0, 30.0))))
