"""Peduncles and pedicels: the shortest ways through thin green points from the main stem to each fruit of a truss.

What holds a fruit is known before it is seen: a peduncle leaves the main stem and branches into one pedicel per fruit.
So each truss is a tree that spans its fruits and the stem, and gaps where something hides it are bridged by the tree
itself: fruits are joined one after the other to what is there already by the shortest path, long hops costing
more than their length (the shortest-path heuristic for Steiner trees, Takahashi and Matsuyama 1980).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from greenhouse_gym.crop import Stem, StemKind, Tomato
from greenhouse_gym.geometry import Array, closest_on_segments, distance_to_spheres
from greenhouse_gym.shapes.polylines import simplified
from greenhouse_gym.shapes.settings import ShapeSettings

_FREE = 1e-3  # of its cost is left of an edge that belongs to the tree
_ADRIFT = 10.0  # times its length a hop costs that is no stem: from the main stem to what hangs on nothing


def find_peduncles(
    points: Array, normals: Array, tomatoes: tuple[Tomato, ...], main: list[Stem], settings: ShapeSettings
) -> list[Stem]:
    """Trace what holds the fruits.

    Args:
        points: (n, 3) what is neither tomato nor main stem nor leaf, metres.
        normals: (n, 3) unit vectors.
        tomatoes: The fruits, with the trusses they hang on.
        main: The main stems.
        settings: All settings.

    Returns:
        Chains of capsules of the kinds ``peduncle`` and ``pedicel``.
    """
    if not len(points) or not tomatoes:
        return []
    # only the near side is seen; the axis lies behind it
    nodes = _thinned(points - settings.peduncle_radius * normals, settings.path_step)
    tree = cKDTree(nodes)
    stems: list[Stem] = []
    for truss in sorted({t.truss for t in tomatoes}):
        fruits = [t for t in tomatoes if t.truss == truss]
        near = tree.query_ball_point([t.center for t in fruits], settings.truss_reach)
        rows = np.unique(np.concatenate([np.asarray(r, dtype=np.int64) for r in near]))
        if len(rows):
            stems += _trace(nodes[rows], fruits, main, settings)
    return stems


def _thinned(points: Array, step: float) -> Array:
    """The means (k, 3) of the points in each cube of a grid."""
    cubes, row = np.unique(np.floor(points / step).astype(np.int64), axis=0, return_inverse=True)
    sums = np.stack([np.bincount(row.ravel(), points[:, k], minlength=len(cubes)) for k in range(3)], axis=1)
    return np.asarray(sums / np.bincount(row.ravel(), minlength=len(cubes))[:, None])


def _trace(nodes: Array, fruits: list[Tomato], main: list[Stem], settings: ShapeSettings) -> list[Stem]:
    """The tree of one truss: node n is the main stem, node n + 1 + k the k-th fruit."""
    count = len(nodes)
    edges, costs = _edges(nodes, fruits, settings)
    feet = _feet(nodes, main)
    roots, root_costs = _root_edges(nodes, feet, edges[(edges < count).all(axis=1)], settings)
    edges = np.concatenate([edges, np.column_stack([np.full(len(roots), count), roots])])
    costs = np.concatenate([costs, root_costs])
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
            costs[edge_of[parent[here], here]] *= _FREE
            here = parent[here]
    return [
        piece
        for way in _branches(parent, count)
        for piece in _capsules(way, _places(way, nodes, fruits, feet, settings), count, settings)
    ]


def _edges(nodes: Array, fruits: list[Tomato], settings: ShapeSettings) -> tuple[npt.NDArray[np.int64], Array]:
    """Edges (m, 2) between near nodes both ways and from nodes to fruits, and their costs (m,)."""
    pairs = cKDTree(nodes).query_pairs(settings.path_gap, output_type="ndarray")
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    skin = distance_to_spheres(nodes, np.array([f.center for f in fruits]), [f.radius for f in fruits])
    at, of = np.nonzero(skin < settings.pedicel_reach)
    edges = np.concatenate([pairs, pairs[:, ::-1], np.column_stack([at, len(nodes) + 1 + of])])
    lengths = np.concatenate([lengths, lengths, np.maximum(skin[at, of], 1e-3)])
    return edges, lengths * (1 + (lengths / settings.path_step) ** 2)


def _feet(nodes: Array, main: list[Stem]) -> Array:
    """The point (n, 3) of the main stems' axes nearest to each node; NaN where there is no main stem."""
    if not main:
        return np.full(nodes.shape, np.nan)
    on_axes = closest_on_segments(nodes, np.array([s.start for s in main]), np.array([s.end for s in main]))
    nearest = np.linalg.norm(on_axes - nodes[:, None], axis=-1).argmin(axis=1)
    return np.asarray(on_axes[np.arange(len(nodes)), nearest])


def _root_edges(
    nodes: Array, feet: Array, edges: npt.NDArray[np.int64], settings: ShapeSettings
) -> tuple[npt.NDArray[np.int64], Array]:
    """Nodes (k,) that the main stem leads to, and what that costs (k,): those near it, and one of every loose part."""
    hop = np.nan_to_num(np.linalg.norm(nodes - feet, axis=1), nan=1.0)
    part = connected_components(coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(len(nodes),) * 2))[1]
    order = np.argsort(hop, kind="stable")
    first = order[np.unique(part[order], return_index=True)[1]]
    rooted = np.union1d(np.flatnonzero(hop < settings.root_reach), first)
    costs = np.where(hop < settings.root_reach, hop * (1 + hop / settings.path_step), _ADRIFT * (1 + hop))
    return rooted, costs[rooted]


def _branches(parent: dict[int, int], root: int) -> list[list[int]]:
    """The tree cut at its forks: ways from a fork, or the root, to the next fork or an end."""
    children: dict[int, list[int]] = {}
    for child, above in parent.items():
        children.setdefault(above, []).append(child)
    ways = []
    for fork, below in children.items():
        if fork != root and len(below) == 1:
            continue
        for child in below:
            way = [fork, child]
            while len(children.get(way[-1], [])) == 1:
                way.append(children[way[-1]][0])
            ways.append(way)
    return ways


def _places(way: list[int], nodes: Array, fruits: list[Tomato], feet: Array, settings: ShapeSettings) -> Array:
    """Where a way runs (k, 3): smooth, from the main stem's axis if it is near, and to the skin of a fruit."""
    root = len(nodes)
    inner = np.array([nodes[k] for k in way if k < root])
    ends = []
    if way[0] == root and np.linalg.norm(feet[way[1]] - nodes[way[1]]) < settings.root_reach:
        inner = np.vstack([feet[way[1]], inner])
    if way[-1] > root:
        fruit = fruits[way[-1] - root - 1]
        away = (inner[-1] if len(inner) else fruit.center + [0.0, 0.0, 1.0]) - fruit.center
        ends = [fruit.center + fruit.radius * away / np.linalg.norm(away)]
    smooth = inner.copy()
    if len(inner) > 2:
        smooth[1:-1] = ndimage.uniform_filter1d(inner, 5, axis=0, mode="nearest")[1:-1]
    return np.vstack([smooth, *ends])


def _capsules(way: list[int], places: Array, root: int, settings: ShapeSettings) -> list[Stem]:
    """A way as few straight pieces; what is left of it before a fruit is its pedicel."""
    if len(places) < 2:
        return []
    knots = simplified(places, settings.axis_tolerance)
    to_end = np.linalg.norm(np.diff(knots[::-1], axis=0), axis=1).cumsum()[::-1]  # from the start of each piece
    pieces = []
    for (a, b), left in zip(pairwise(knots), to_end, strict=True):
        is_pedicel = way[-1] > root and left < settings.longest_pedicel
        kind: StemKind = "pedicel" if is_pedicel else "peduncle"
        pieces.append(Stem(a, b, settings.pedicel_radius if is_pedicel else settings.peduncle_radius, kind=kind))
    return pieces
