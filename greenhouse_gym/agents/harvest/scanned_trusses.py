"""Trusses of a scan: where each leaves its main stem, about which it turns, and its pieces of stem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.distances import closest_on_segments
from greenhouse_gym.scene.obstacles import Surroundings

_SAME, _LINKED = 1e-5, 0.05  # metres between ends of pieces that touch, and from fruit to a piece of their rachis
_JOINED, _HIGH = 0.1, 0.25  # metres from a rachis, or from fruit without one, to the main stem that they hang on
_PEDUNCLE = np.array([0.0, 0.0, 0.12])  # metres from fruit to where they hang, if nothing else is known


class ScannedTrusses(NamedTuple):
    """Trusses of a scan.

    Attributes:
        of: (tomatoes,) truss of each tomato.
        roots: (trusses, 3) points about which they turn, metres.
        stems: (stems,) truss of each piece of stem, or -1.
    """

    of: npt.NDArray[np.int64]
    roots: Array
    stems: npt.NDArray[np.int64]


def scanned_trusses(scene: Surroundings) -> ScannedTrusses:
    """Return the trusses of a scan, whose rachises may be incomplete: a root is where one comes near a main stem."""
    centers = np.array([tomato.center for tomato in scene.tomatoes]).reshape(-1, 3)
    _, of = np.unique([tomato.truss for tomato in scene.tomatoes], return_inverse=True)
    stems = np.full(len(scene.stems), -1)
    own = np.array([k for k, stem in enumerate(scene.stems) if stem.kind in ("peduncle", "pedicel")], dtype=np.int64)
    ends = np.array([[scene.stems[k].start, scene.stems[k].end] for k in own.tolist()]).reshape(-1, 2, 3)
    if len(own) and len(centers):
        connected = _connected(ends)
        points = np.concatenate([ends, ends.mean(axis=1, keepdims=True)], axis=1)
        apart = cdist(points.reshape(-1, 3), centers).reshape(len(own), 3, len(centers)).min(axis=1)
        for group in range(connected.max() + 1):
            nearest = apart[connected == group].min(axis=0)
            if nearest.min() < _LINKED:
                stems[own[connected == group]] = of[nearest.argmin()]
    main = [stem for stem in scene.stems if stem.kind == "main"]
    roots = []
    for truss in range(of.max() + 1 if len(of) else 0):
        rachis = ends[stems[own] == truss].reshape(-1, 3)
        roots.append(_root(centers[of == truss], rachis, [stem.start for stem in main], [stem.end for stem in main]))
    return ScannedTrusses(of, np.array(roots).reshape(-1, 3), stems)


def _connected(ends: Array) -> npt.NDArray[np.int64]:
    """Return a number (n,) for each piece (n, 2, 3), which pieces have in common whose ends touch."""
    cells = np.round(ends.reshape(-1, 3) / _SAME).astype(np.int64)
    _, node = np.unique(cells, axis=0, return_inverse=True)
    first, second = node.reshape(-1, 2).T
    count = int(node.max()) + 1
    _, group = connected_components(coo_matrix((np.ones(len(first)), (first, second)), (count, count)), directed=False)
    _, numbers = np.unique(group[first], return_inverse=True)
    return np.asarray(numbers)


def _root(fruit: Array, rachis: Array, starts: list[Array], ends: list[Array]) -> Array:
    """Return the point (3,) about which a truss turns."""
    top = fruit[fruit[:, 2].argmax()]
    if not starts:
        return np.asarray(rachis[rachis[:, 2].argmax()] if len(rachis) else top + _PEDUNCLE)
    points, limit = (rachis, _JOINED) if len(rachis) else (top[None], _HIGH)
    on_stem = closest_on_segments(points, starts, ends)
    apart = np.linalg.norm(on_stem - points[:, None], axis=2)
    point, stem = np.unravel_index(apart.argmin(), apart.shape)
    if apart[point, stem] < limit:
        return np.asarray(on_stem[point, stem])
    return np.asarray(rachis[rachis[:, 2].argmax()] if len(rachis) else top + _PEDUNCLE)
