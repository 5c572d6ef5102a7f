"""Peduncles and pedicels: the shortest ways through likely places from the main stem to each fruit of a truss.

What holds a fruit is known before it is seen: a peduncle leaves the main stem, above the middle of the fruits that hang
on it, and branches into one pedicel per fruit. So each truss is a tree that spans its fruits and the stem, and gaps
where something hides it are bridged by the tree itself: fruits are joined one after the other to what is there already
by the shortest path, long hops costing more than their length (the shortest-path heuristic for Steiner trees, Takahashi
and Matsuyama 1980).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem, StemKind, Tomato
from greenhouse_gym.geometry import Array, closest_on_segments, distance_to_spheres
from greenhouse_gym.shapes.polylines import fitted, smoothed
from greenhouse_gym.shapes.settings import ShapeSettings

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

_KEPT = 0.5  # share of its cost that is left of an edge that belongs to the tree
_ADRIFT = 100.0  # so many times its length a hop costs that is no stem: from the main stem to what hangs on nothing


def find_peduncles(nodes: Array, tomatoes: tuple[Tomato, ...], main: list[Stem], settings: ShapeSettings) -> list[Stem]:
    """Trace what holds the fruits.

    Args:
        nodes: (n, 3) places on axes of what may be peduncles, metres.
        tomatoes: The fruits, with the trusses they hang on.
        main: The main stems.
        settings: All settings.

    Returns:
        Chains of capsules of the kinds ``peduncle`` and ``pedicel``.
    """
    if not len(nodes) or not tomatoes:
        return []
    tree = cKDTree(nodes)
    stems: list[Stem] = []
    for truss in sorted({t.truss for t in tomatoes}):
        fruits = [t for t in tomatoes if t.truss == truss]
        near = tree.query_ball_point([t.center for t in fruits], settings.truss_reach)
        rows = np.unique(np.concatenate([np.asarray(r, dtype=np.int64) for r in near]))
        if len(rows):
            stems += _trace(nodes[rows], fruits, main, settings)
    return stems


def _trace(nodes: Array, fruits: list[Tomato], main: list[Stem], settings: ShapeSettings) -> list[Stem]:
    """The tree of one truss: node n is the main stem, node n + 1 + k the k-th fruit."""
    count = len(nodes)
    feet = _feet(nodes, main)
    rooted = np.linalg.norm(nodes - feet, axis=1) < settings.root_reach
    rooted &= feet[:, 2] > np.mean([f.center[2] for f in fruits])
    edges, costs = _edges(nodes, fruits, feet, rooted, settings)
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
            costs[edge_of[parent[here], here]] *= _KEPT
            here = parent[here]
    _cut_weak_bridges(parent, nodes, settings)
    feet[~rooted] = np.nan
    pieces: list[Stem] = []
    for way in _ways(parent, nodes):
        pieces += _capsules(_places(way, nodes, fruits, feet, pieces), settings)
    return pieces


def _feet(nodes: Array, main: list[Stem]) -> Array:
    """The point (n, 3) of the main stems' axes nearest to each node; NaN where there is no main stem."""
    if not main:
        return np.full(nodes.shape, np.nan)
    on_axes = closest_on_segments(nodes, np.array([s.start for s in main]), np.array([s.end for s in main]))
    nearest = np.linalg.norm(on_axes - nodes[:, None], axis=-1).argmin(axis=1)
    return np.asarray(on_axes[np.arange(len(nodes)), nearest])


def _edges(
    nodes: Array, fruits: list[Tomato], feet: Array, rooted: Mask, settings: ShapeSettings
) -> tuple[Rows, Array]:
    """Edges (m, 2) and their costs (m,): between nodes both ways, from nodes to fruits and from the main stem to nodes.

    Near nodes are joined, and parts of what they make by the shortest hop between each two. The main stem leads to all
    nodes rooted in it, and to the nearest of each part.
    """
    count = len(nodes)
    pairs = cKDTree(nodes).query_pairs(settings.path_gap, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    part = connected_components(links, directed=False)[1]
    pairs = np.concatenate([pairs, _bridges(nodes, part, settings)])
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    skin = distance_to_spheres(nodes, np.array([f.center for f in fruits]), [f.radius for f in fruits])
    at, of = np.nonzero(skin < settings.pedicel_reach)
    hop = np.nan_to_num(np.linalg.norm(nodes - feet, axis=1), nan=1.0)
    order = np.argsort(hop, kind="stable")
    roots = np.union1d(np.flatnonzero(rooted), order[np.unique(part[order], return_index=True)[1]])
    root_costs = np.where(rooted, hop * (1 + hop / settings.path_step), _ADRIFT * (1 + hop))[roots]
    lengths = np.concatenate([lengths, lengths, np.maximum(skin[at, of], 1e-3)])
    edges = [
        pairs,
        pairs[:, ::-1],
        np.column_stack([at, count + 1 + of]),
        np.column_stack([np.full_like(roots, count), roots]),
    ]
    return np.concatenate(edges), np.concatenate([hop_costs(lengths, settings), root_costs])


def hop_costs(lengths: Array, settings: ShapeSettings) -> Array:
    """Costs (m,) of hops of some lengths (m,), metres: longer ones cost more than their length."""
    return lengths * (1 + (lengths / settings.path_step) ** 2)


def _bridges(nodes: Array, part: Rows, settings: ShapeSettings) -> Rows:
    """Where parts are nearest to each other (k, 2), for every two that may be one with something in front of it."""
    small = np.flatnonzero(part != np.bincount(part).argmax())  # one of two parts is not the largest
    hops = cKDTree(nodes[small]).sparse_distance_matrix(cKDTree(nodes), settings.path_bridge, output_type="coo_matrix")
    ends, lengths = np.column_stack([small[hops.row], hops.col]), hops.data
    apart = part[ends[:, 0]] != part[ends[:, 1]]
    ends = ends[apart][np.argsort(lengths[apart], kind="stable")]
    between = np.sort(part[ends], axis=1).astype(np.int64) @ [len(nodes), 1]
    return np.asarray(ends[np.unique(between, return_index=True)[1]])


def _cut_weak_bridges(parent: dict[int, int], nodes: Array, settings: ShapeSettings) -> None:
    """Set what lies beyond a wide gap adrift, unless several fruits speak for the bridge."""
    root = len(nodes)
    ahead = dict.fromkeys(parent, 0)
    for here in [k for k in parent if k > root]:
        while here != root:
            ahead[here] += 1
            here = parent[here]
    for child, above in parent.items():
        weak = max(child, above) < root and ahead[child] < settings.bridge_fruits
        if weak and np.linalg.norm(nodes[child] - nodes[above]) > settings.path_gap:
            parent[child] = root


def _ways(parent: dict[int, int], nodes: Array) -> list[list[int]]:
    """The tree as ways to its fruits: the longest from the root, each other from where it leaves one before."""
    root = len(nodes)
    ways = []
    for end in [k for k in parent if k > root]:
        way = [end]
        while way[-1] != root:
            way.append(parent[way[-1]])
        ways.append(way[::-1])
    ways.sort(key=lambda way: -float(np.linalg.norm(np.diff(nodes[way[1:-1]], axis=0), axis=1).sum()))
    seen: set[int] = set()
    for k, way in enumerate(ways):
        known = sum(place in seen for place in way[1:])
        seen.update(way)
        ways[k] = way[known:]
    return ways


def _places(way: list[int], nodes: Array, fruits: list[Tomato], feet: Array, before: list[Stem]) -> Array:
    """Where a way runs (k, 3): smooth, to the skin of a fruit, and from what it leaves.

    That is the axis of the main stem if it is rooted there, or of one of the pieces ``before``.
    """
    root, fruit = len(nodes), fruits[way[-1] - len(nodes) - 1]
    inner = nodes[way[1:-1]]
    if way[0] != root:
        from_axes = closest_on_segments(
            nodes[way[:1]], np.array([s.start for s in before]), np.array([s.end for s in before])
        )[0]
        inner = np.vstack([from_axes[np.linalg.norm(from_axes - nodes[way[0]], axis=1).argmin()], inner])
    elif np.isfinite(feet[way[1]]).all():
        inner = np.vstack([feet[way[1]], inner])
    away = inner[-1] - fruit.center
    skin = fruit.center + fruit.radius * away / np.linalg.norm(away)
    return np.vstack([smoothed(inner), skin])


def _capsules(places: Array, settings: ShapeSettings) -> list[Stem]:
    """A way as few straight pieces; what is left of it before the fruit is its pedicel."""
    knots = fitted(places, settings.axis_tolerance)
    knots[[0, -1]] = places[[0, -1]]
    to_end = np.linalg.norm(np.diff(knots[::-1], axis=0), axis=1).cumsum()[::-1]  # from the start of each piece
    pieces = []
    for (a, b), left in zip(pairwise(knots), to_end, strict=True):
        is_pedicel = left < settings.longest_pedicel
        kind: StemKind = "pedicel" if is_pedicel else "peduncle"
        pieces.append(Stem(a, b, settings.pedicel_radius if is_pedicel else settings.peduncle_radius, kind=kind))
    return pieces
