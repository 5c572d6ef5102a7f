"""Probability that points lie on peduncles, and peduncles and pedicels traced through probable points.

The second network also sees the output of the first in the neighborhood (auto-context; Tu and Bai, 2010): peduncles
are lines of probable points, while edges of leaves are probable only here and there. A path bridges what is occluded,
and on a cloud unlike those the network was fitted to it may lead anywhere, so pieces that hardly any such point
supports are dropped.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.robust_fit import fit_polyline, smooth_polyline
from greenhouse_gym.shapes.stems.peduncle_features import PATH_STEP, PEDUNCLE_RADIUS, PeduncleCandidates
from greenhouse_gym.shapes.stems.peduncles import find_peduncles, hop_costs

MIN_LENGTH = 0.025
"""Shortest peduncle in metres, from end to end."""

_MAX_HOP = 2.25  # path steps from one point of a chain to the next
_CLEARANCE = 0.010  # metres from other stems

MIN_PROBABILITY, MIN_BARE_PROBABILITY = 0.2, 0.5
"""Probability of the points through which stems with and without detected fruit are traced."""

_MIN_SUPPORT = {"peduncle": 0.25, "pedicel": 0.4}
"""Least mean probability along a piece, chosen on rows 501, 932, 934 of Helios' plants and 302 of own ones."""

_SUPPORT_REACH, _SUPPORT_STEP = 0.005, 0.002  # metres from a piece to points that support it, and between samples

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


def find_bare_peduncles(nodes: Array, others: Sequence[Stem], axis_tolerance: float) -> list[Stem]:
    """Trace peduncles without detected fruit.

    Args:
        nodes: (n, 3) points on the axes of probable peduncles, metres.
        others: The main stems, and the stems that hold the detected fruits.
        axis_tolerance: Largest distance of the capsules from the traced axis, metres.

    Returns:
        Chains of capsules of kind ``peduncle``.
    """
    bare = nodes[nearest_shapes(nodes, others, _CLEARANCE).owner < 0]
    stems: list[Stem] = []
    for chain in _chains(bare):
        if np.linalg.norm(chain[0] - chain[-1]) >= MIN_LENGTH:
            knots = fit_polyline(smooth_polyline(chain), axis_tolerance)
            stems += [Stem(a, b, PEDUNCLE_RADIUS, kind="peduncle") for a, b in pairwise(knots)]
    return stems


def _chains(nodes: Array) -> Iterator[Array]:
    """Yield the longest of the shortest paths (k, 3) through each connected part of the nodes (n, 3)."""
    pairs = cKDTree(nodes).query_pairs(_MAX_HOP * PATH_STEP, output_type="ndarray")
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    graph = coo_array((hop_costs(lengths), tuple(pairs.T)), shape=(len(nodes), len(nodes))).tocsr()
    _, first = np.unique(connected_components(graph, directed=False)[1], return_index=True)
    for inside in first.tolist():
        start = _farthest(dijkstra(graph, directed=False, indices=inside))
        distance, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        path = [_farthest(distance)]
        while path[-1] != start:
            path.append(int(before[path[-1]]))
        yield nodes[path]


def _farthest(distance: Array) -> int:
    """Return the index of the farthest reachable node."""
    return int(np.where(np.isfinite(distance), distance, -1.0).argmax())


def trace_peduncles(
    nodes: Array, probability: Array, tomatoes: tuple[Tomato, ...], main: list[Stem], axis_tolerance: float
) -> list[Stem]:
    """Trace the peduncles and pedicels of detected fruit, then peduncles without detected fruit.

    Args:
        nodes: (n, 3) points on the axes of possible peduncles, metres.
        probability: (n,) that a node lies on a peduncle or pedicel.
        tomatoes: The fruits, with the trusses they hang on.
        main: The main stems.
        axis_tolerance: Largest distance of the capsules from the traced axis, metres.
    """
    found = find_peduncles(nodes[probability > MIN_PROBABILITY], tomatoes, main, axis_tolerance)
    bare = nodes[probability > MIN_BARE_PROBABILITY]
    found += find_bare_peduncles(bare, [*main, *found], axis_tolerance)
    support = _support(found, nodes, probability)
    return [stem for stem, own in zip(found, support, strict=True) if own >= _MIN_SUPPORT[stem.kind]]


def _support(stems: Sequence[Stem], nodes: Array, probability: Array) -> list[float]:
    """Return the mean over each stem's axis of the highest probability near it, 0 where no node is near."""
    tree = cKDTree(nodes)
    support = []
    for stem in stems:
        count = int(np.ceil(stem.length / _SUPPORT_STEP)) + 1
        along = (np.arange(count) + 0.5)[:, None] / count
        near = tree.query_ball_point(stem.start + along * (stem.end - stem.start), _SUPPORT_REACH)
        support.append(float(np.mean([probability[rows].max(initial=0.0) for rows in near])))
    return support


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
