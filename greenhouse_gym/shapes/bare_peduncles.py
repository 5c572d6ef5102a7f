"""Peduncles of which no fruit was found: chains of likely places that no truss's tree runs along.

The fruit may be hidden, too young to be seen, or still in flower, or hang at another end than the one that shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.peduncles import hop_costs
from greenhouse_gym.shapes.polylines import fitted, smoothed
from greenhouse_gym.shapes.settings import ShapeSettings

_STEPS = 2.25  # path steps from one place of a chain to the next, at most
_CLEAR = 0.010  # metres off other stems


def find_bare_peduncles(nodes: Array, others: Sequence[Stem], settings: ShapeSettings) -> list[Stem]:
    """Trace what holds no fruit that was found.

    Args:
        nodes: (n, 3) places on axes of what probably are peduncles, metres.
        others: The main stems, and what holds the fruits that were found.
        settings: All settings.

    Returns:
        Chains of capsules of the kind ``peduncle``.
    """
    bare = nodes[nearest_shapes(nodes, others, _CLEAR).owner < 0]
    stems: list[Stem] = []
    for chain in _chains(bare, settings):
        if np.linalg.norm(chain[0] - chain[-1]) >= settings.shortest_bare_peduncle:
            knots = fitted(smoothed(chain), settings.axis_tolerance)
            stems += [Stem(a, b, settings.peduncle_radius, kind="peduncle") for a, b in pairwise(knots)]
    return stems


def _chains(nodes: Array, settings: ShapeSettings) -> Iterator[Array]:
    """The longest of the shortest ways (k, 3) through each part of the places (n, 3) that are near each other."""
    pairs = cKDTree(nodes).query_pairs(_STEPS * settings.path_step, output_type="ndarray")
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    graph = coo_array((hop_costs(lengths, settings), tuple(pairs.T)), shape=(len(nodes), len(nodes))).tocsr()
    _, first = np.unique(connected_components(graph, directed=False)[1], return_index=True)
    for inside in first.tolist():
        start = _farthest(dijkstra(graph, directed=False, indices=inside))
        distance, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        way = [_farthest(distance)]
        while way[-1] != start:
            way.append(int(before[way[-1]]))
        yield nodes[way]


def _farthest(distance: Array) -> int:
    """The place that is farthest, of those that can be reached."""
    return int(np.where(np.isfinite(distance), distance, -1.0).argmax())
