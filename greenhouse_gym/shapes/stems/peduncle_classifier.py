"""Probability that candidate points lie on peduncles, first of each point by itself, then with its neighbors.

The second network also sees the first one's output in the neighborhood (auto-context; Tu and Bai, 2010): peduncles are
lines of probable points, while edges of leaves are probable only here and there.
"""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.stems.peduncle_features import PeduncleCandidates

_REACHES = (0.010, 0.020, 0.030)  # metres
_MIN_WEIGHT = 1e-3  # weight of the most improbable point
_SOFTENING = 0.01  # added before logarithms are taken
_MIN_VARIANCE = 1e-7  # square metres, added to the extent of a single point
_AROUND = ("sum", "mean", "linear", "width", "extent", "off line", "along line", "upright")

CONTEXT = ("own", *(f"{name}, {1e3 * reach:g} mm" for reach in _REACHES for name in _AROUND))
"""Names of the features of a point that describe probabilities.

Its own, as log odds, and for the points around it, weighted by their probability: the logarithm of its sum, its mean,
how linear they are, their extent across and along, the point's distance from their line and, along it, from their
centroid, and how upright a line they form.
"""


def peduncle_probability(candidates: PeduncleCandidates) -> Array:
    """Return the probability (n,) that each candidate lies on a peduncle or pedicel."""
    first = network("stems/peduncles")(candidates.features)
    return network("stems/peduncles_in_context")(with_context(candidates, first))


def with_context(candidates: PeduncleCandidates, first: Array) -> Array:
    """Return the features of candidates (n, m) with those of their first probabilities (n,), by `CONTEXT`."""
    if not len(first):
        return np.zeros((0, candidates.features.shape[1] + len(CONTEXT)))
    log_odds = np.log((first + _SOFTENING) / (1 + _SOFTENING - first))
    around = [_features_around(candidates.nodes, first, reach) for reach in _REACHES]
    return np.column_stack([candidates.features, log_odds, *around])


def _features_around(nodes: Array, first: Array, reach: float) -> Array:
    near, weights = Neighborhoods(nodes, reach), (first + _MIN_WEIGHT)[:, None]
    mean = near.mean(weights)
    middle = near.mean(weights * nodes) / mean
    spread = near.moments(weights * nodes, nodes) / mean[:, :, None] - middle[:, :, None] * middle[:, None, :]
    variances, axes = np.linalg.eigh(spread)
    wide, long = np.maximum(variances[:, 1:], 0.0).T
    line, offset = axes[:, :, 2], nodes - middle
    along = (offset * line).sum(axis=1)
    off = np.linalg.norm(offset - along[:, None] * line, axis=1)
    probability, linear = mean[:, 0], (long - wide) / (long + _MIN_VARIANCE)
    return np.column_stack([
        np.log(probability * near.count + _SOFTENING), probability, linear, np.sqrt(wide) / reach,
        np.sqrt(long) / reach, off / reach, np.abs(along) / reach, linear * np.abs(line[:, 2]),
    ])  # fmt: skip
