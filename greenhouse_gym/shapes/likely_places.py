"""How likely places are on peduncles: by themselves first, and then by whether likely places line up around them.

A second network is told what the first one says of the neighborhood (auto-context; Tu and Bai, 2010): peduncles are
lines of likely places, and edges of leaves are likely here and there.
"""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.thin_stems import Places

_REACHES = (0.010, 0.020, 0.030)  # metres
_LEAST = 1e-3  # weight of a place that is as unlikely as can be
_SOFT = 0.01  # added to likelihoods and to sums of them before logarithms are taken
_SPECK = 1e-7  # square metres, of what spreads nowhere
_AROUND = ("sum", "mean", "linear", "width", "extent", "off line", "along line", "upright")

CONTEXT = ("by itself", *(f"{name}, {1e3 * reach:g} mm" for reach in _REACHES for name in _AROUND))
"""What is measured of each place's likelihood: by itself, as log odds, and of what lies around.

Of that: how many likely places there are (a logarithm) and how likely they are in the mean; how long they spread, how
far across and along, each weighing as much as it is likely; how far off their line and from their middle it lies; and
how upright their line is, as far as they make one.
"""


def likelihood(places: Places) -> Array:
    """How likely each place (n,) is on a peduncle or pedicel, 0 to 1."""
    first = network("peduncles")(places.measures)
    return network("peduncles_in_context")(in_context(places, first))


def in_context(places: Places, first: Array) -> Array:
    """The measures of places (n, m) beside those of how likely they are at first sight (n,), by `CONTEXT`."""
    if not len(first):
        return np.zeros((0, places.measures.shape[1] + len(CONTEXT)))
    by_itself = np.log((first + _SOFT) / (1 + _SOFT - first))
    return np.column_stack([places.measures, by_itself, *(_around(places.nodes, first, reach) for reach in _REACHES)])


def _around(nodes: Array, first: Array, reach: float) -> Array:
    near, weights = Neighborhoods(nodes, reach), (first + _LEAST)[:, None]
    mean = near.mean(weights)
    middle = near.mean(weights * nodes) / mean
    spread = near.moments(weights * nodes, nodes) / mean[:, :, None] - middle[:, :, None] * middle[:, None, :]
    variances, axes = np.linalg.eigh(spread)
    wide, long = np.maximum(variances[:, 1:], 0.0).T
    line, away = axes[:, :, 2], nodes - middle
    along = (away * line).sum(axis=1)
    off = np.linalg.norm(away - along[:, None] * line, axis=1)
    likely, linear = mean[:, 0], (long - wide) / (long + _SPECK)
    return np.column_stack([
        np.log(likely * near.count + _SOFT), likely, linear, np.sqrt(wide) / reach, np.sqrt(long) / reach,
        off / reach, np.abs(along) / reach, linear * np.abs(line[:, 2]),
    ])  # fmt: skip
