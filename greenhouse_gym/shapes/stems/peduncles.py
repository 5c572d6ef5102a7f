"""Peduncles and pedicels: shortest paths through probable points from the main stem to each fruit of a truss.

The structure that holds a fruit is known before it is seen: a peduncle leaves the main stem above the middle of its
fruits and branches into one pedicel per fruit. So each truss is a tree that spans its fruits and the stem, and occluded
gaps are bridged by the tree itself: fruits are joined one after the other to the tree by the shortest path, where long
hops cost more than their length (the shortest-path heuristic for Steiner trees, Takahashi and Matsuyama 1980).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem, StemKind, Tomato
from greenhouse_gym.geometry import Array, closest_on_segments, distance_to_spheres
from greenhouse_gym.shapes.robust_fit import fit_polyline, smooth_polyline
from greenhouse_gym.shapes.stems.peduncle_features import PATH_STEP, PEDUNCLE_RADIUS, TRUSS_REACH

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

_PEDICEL_RADIUS = 0.0013  # metres, too thin to measure
_MAX_PEDICEL = 0.030  # metres: length of the longest pedicel
_MAX_GAP = 0.015  # metres of a peduncle that may be occluded
_MAX_BRIDGE = 0.060  # the same where several fruits hang on the peduncle
_MIN_BRIDGE_FRUITS = 2  # number of fruits that justify such a bridge
_ROOT_REACH = 0.025  # metres from a main stem's axis within which a peduncle may begin
_PEDICEL_REACH = 0.016  # metres from the skin of its fruit within which a pedicel may end
_REUSE = 0.5  # cost factor of edges that already belong to the tree
_DETACHED = 100.0  # cost factor of hops that are no stem: from the main stem to parts that hang on nothing


def find_peduncles(nodes: Array, tomatoes: tuple[Tomato, ...], main: list[Stem], axis_tolerance: float) -> list[Stem]:
    """Trace the stems that hold the fruits.

    Args:
        nodes: (n, 3) points on the axes of possible peduncles, metres.
        tomatoes: The fruits, with the trusses they hang on.
        main: The main stems.
        axis_tolerance: Largest distance of the capsules from the traced axis, metres.

    Returns:
        Chains of capsules of the kinds ``peduncle`` and ``pedicel``.
    """
    if not len(nodes) or not tomatoes:
        return []
    tree = cKDTree(nodes)
    stems: list[Stem] = []
    for truss in sorted({t.truss for t in tomatoes}):
        fruits = [t for t in tomatoes if t.truss == truss]
        near = tree.query_ball_point([t.center for t in fruits], TRUSS_REACH)
        rows = np.unique(np.concatenate([np.asarray(r, dtype=np.int64) for r in near]))
        if len(rows):
            stems += _trace(nodes[rows], fruits, main, axis_tolerance)
    return stems


def _trace(nodes: Array, fruits: list[Tomato], main: list[Stem], axis_tolerance: float) -> list[Stem]:
    """Trace the tree of one truss: node n is the main stem, node n + 1 + k the k-th fruit."""
    count = len(nodes)
    feet = _feet(nodes, main)
    rooted = np.linalg.norm(nodes - feet, axis=1) < _ROOT_REACH
    rooted &= feet[:, 2] > np.mean([f.center[2] for f in fruits])
    edges, costs = _edges(nodes, fruits, feet, rooted)
    edge_of = {(int(a), int(b)): k for k, (a, b) in enumerate(edges)}
    size = count + 1 + len(fruits)
    parent: dict[int, int] = {}
    waiting = [count + 1 + k for k in range(len(fruits))]
    while waiting:
        graph = coo_array((costs, tuple(edges.T)), shape=(size, size)).tocsr()
        distance, before = dijkstra(graph, indices=count, return_predecessors=True)
        here = min(waiting, key=lambda k: float(distance[k]))
        if not np.isfinite(distance[here]):
            break
        waiting.remove(here)
        while here != count and here not in parent:
            parent[here] = int(before[here])
            costs[edge_of[parent[here], here]] *= _REUSE
            here = parent[here]
    _cut_weak_bridges(parent, nodes)
    feet[~rooted] = np.nan
    pieces: list[Stem] = []
    for path in _paths(parent, nodes):
        pieces += _capsules(_path_points(path, nodes, fruits, feet, pieces), axis_tolerance)
    return pieces


def _feet(nodes: Array, main: list[Stem]) -> Array:
    """Return the point (n, 3) on the main stems' axes nearest to each node; NaN if there is no main stem."""
    if not main:
        return np.full(nodes.shape, np.nan)
    on_axes = closest_on_segments(nodes, np.array([s.start for s in main]), np.array([s.end for s in main]))
    nearest = np.linalg.norm(on_axes - nodes[:, None], axis=-1).argmin(axis=1)
    return np.asarray(on_axes[np.arange(len(nodes)), nearest])


def _edges(nodes: Array, fruits: list[Tomato], feet: Array, rooted: Mask) -> tuple[Rows, Array]:
    """Return edges (m, 2) and costs (m,): between nodes in both directions, to fruits, and from the main stem.

    Near nodes are joined, and the connected parts by the shortest hop between each two. The main stem leads to all
    nodes rooted in it, and to the nearest node of each part.
    """
    count = len(nodes)
    pairs = cKDTree(nodes).query_pairs(_MAX_GAP, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    part = connected_components(links, directed=False)[1]
    pairs = np.concatenate([pairs, _bridges(nodes, part)])
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    skin = distance_to_spheres(nodes, np.array([f.center for f in fruits]), [f.radius for f in fruits])
    node, fruit = np.nonzero(skin < _PEDICEL_REACH)
    hop = np.nan_to_num(np.linalg.norm(nodes - feet, axis=1), nan=1.0)
    order = np.argsort(hop, kind="stable")
    roots = np.union1d(np.flatnonzero(rooted), order[np.unique(part[order], return_index=True)[1]])
    root_costs = np.where(rooted, hop * (1 + hop / PATH_STEP), _DETACHED * (1 + hop))[roots]
    lengths = np.concatenate([lengths, lengths, np.maximum(skin[node, fruit], 1e-3)])
    edges = [
        pairs,
        pairs[:, ::-1],
        np.column_stack([node, count + 1 + fruit]),
        np.column_stack([np.full_like(roots, count), roots]),
    ]
    return np.concatenate(edges), np.concatenate([hop_costs(lengths), root_costs])


def hop_costs(lengths: Array) -> Array:
    """Return the costs (m,) of hops of given lengths (m,), metres: long hops cost more than their length."""
    return lengths * (1 + (lengths / PATH_STEP) ** 2)


def _bridges(nodes: Array, part: Rows) -> Rows:
    """Return the shortest hops (k, 2) between any two parts that may be one behind an occluder."""
    small = np.flatnonzero(part != np.bincount(part).argmax())  # at least one of two parts is not the largest
    hops = cKDTree(nodes[small]).sparse_distance_matrix(cKDTree(nodes), _MAX_BRIDGE, output_type="coo_matrix")
    ends, lengths = np.column_stack([small[hops.row], hops.col]), hops.data
    apart = part[ends[:, 0]] != part[ends[:, 1]]
    ends = ends[apart][np.argsort(lengths[apart], kind="stable")]
    between = np.sort(part[ends], axis=1).astype(np.int64) @ [len(nodes), 1]
    return np.asarray(ends[np.unique(between, return_index=True)[1]])


def _cut_weak_bridges(parent: dict[int, int], nodes: Array) -> None:
    """Detach the part beyond a wide gap, unless several fruits hang on the bridge."""
    root = len(nodes)
    ahead = dict.fromkeys(parent, 0)
    for here in [k for k in parent if k > root]:
        while here != root:
            ahead[here] += 1
            here = parent[here]
    for child, above in parent.items():
        weak = max(child, above) < root and ahead[child] < _MIN_BRIDGE_FRUITS
        if weak and np.linalg.norm(nodes[child] - nodes[above]) > _MAX_GAP:
            parent[child] = root


def _paths(parent: dict[int, int], nodes: Array) -> list[list[int]]:
    """Return the tree as paths to its fruits: the longest from the root, each other from where it leaves one before."""
    root = len(nodes)
    paths = []
    for end in [k for k in parent if k > root]:
        path = [end]
        while path[-1] != root:
            path.append(parent[path[-1]])
        paths.append(path[::-1])
    paths.sort(key=lambda path: -float(np.linalg.norm(np.diff(nodes[path[1:-1]], axis=0), axis=1).sum()))
    visited: set[int] = set()
    for k, path in enumerate(paths):
        known = sum(node in visited for node in path[1:])
        visited.update(path)
        paths[k] = path[known:]
    return paths


def _path_points(path: list[int], nodes: Array, fruits: list[Tomato], feet: Array, before: Sequence[Stem]) -> Array:
    """Return the points (k, 3) of a path, smoothed, from where it begins to the skin of its fruit.

    It begins on the axis of the main stem if it is rooted there, or of one of the pieces ``before``.
    """
    root, fruit = len(nodes), fruits[path[-1] - len(nodes) - 1]
    inner = nodes[path[1:-1]]
    if path[0] != root:
        from_axes = closest_on_segments(
            nodes[path[:1]], np.array([s.start for s in before]), np.array([s.end for s in before])
        )[0]
        inner = np.vstack([from_axes[np.linalg.norm(from_axes - nodes[path[0]], axis=1).argmin()], inner])
    elif np.isfinite(feet[path[1]]).all():
        inner = np.vstack([feet[path[1]], inner])
    outwards = inner[-1] - fruit.center
    skin = fruit.center + fruit.radius * outwards / np.linalg.norm(outwards)
    return np.vstack([smooth_polyline(inner), skin])


def _capsules(points: Array, axis_tolerance: float) -> list[Stem]:
    """Return a path as straight pieces; the last ones before the fruit are its pedicel."""
    knots = fit_polyline(points, axis_tolerance)
    knots[[0, -1]] = points[[0, -1]]
    to_end = np.linalg.norm(np.diff(knots[::-1], axis=0), axis=1).cumsum()[::-1]  # from the start of each piece
    pieces = []
    for (a, b), left in zip(pairwise(knots), to_end, strict=True):
        is_pedicel = left < _MAX_PEDICEL
        kind: StemKind = "pedicel" if is_pedicel else "peduncle"
        pieces.append(Stem(a, b, _PEDICEL_RADIUS if is_pedicel else PEDUNCLE_RADIUS, kind=kind))
    return pieces
