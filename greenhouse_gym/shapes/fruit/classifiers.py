"""Classifiers that score spheres as fruit: a logistic regression for seeds, then a network per pass.

training/shape_networks.py fits both to rows of plants.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.networks import network

Classifier = Callable[[Array], Array]
"""Returns the confidence (k,), 0 to 1, that spheres with features (k, m) are fruit."""

SEED_WEIGHTS = np.array([
    12.54, -12.55, -1.977, 1.232, 55.67, -4.928, -2.524, 5.869, -1.454, -2.269, 5.039, 2.666, 9.603, 0.4137,
    0.8649, 2.43, 1.074, -55.88,
])  # fmt: skip
"""Logistic weights of `sphere_features.SPHERE_FEATURES`, and the offset."""


class SphereClassifiers(NamedTuple):
    """Classifiers of the spheres of the first and of the second pass."""

    first: Classifier
    second: Classifier


def shipped_classifiers() -> SphereClassifiers:
    """Return the shipped networks.

    Their features are those of `sphere_features`, `context_features` and `shell_features`, in this order.
    """
    return SphereClassifiers(network("fruit/first_pass"), network("fruit/second_pass"))


def logistic(features: Array, weights: Array) -> Array:
    """Return probabilities (k,) from features (k, m) and their weights with the offset (m + 1,)."""
    return np.asarray(1 / (1 + np.exp(-np.clip(features @ weights[:-1] + weights[-1], -30.0, 30.0))))
