"""Peduncles without detected fruit: chains of probable points that no truss's tree follows.

The fruit may be hidden, too young to be detected, still in flower, or out of view at the other end.
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
from greenhouse_gym.shapes.stems.peduncle_features import PATH_STEP, PEDUNCLE_RADIUS
from greenhouse_gym.shapes.stems.peduncles import hop_costs
from greenhouse_gym.shapes.stems.polylines import fit_polyline, smooth_polyline

MIN_LENGTH = 0.025
"""Shortest peduncle in metres, from end to end."""

_MAX_HOP = 2.25  # path steps from one point of a chain to the next
_CLEARANCE = 0.010  # metres from other stems


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
