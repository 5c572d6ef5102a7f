"""Clutter: what no tomato and no stem explains, covered by few oriented boxes.

Conservative: every point of a piece lies in its box. Not bloated: the box that wastes most is split first.
"""

from __future__ import annotations

import heapq

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Box
from greenhouse_gym.shapes.settings import ShapeSettings

THINNEST = 0.0025
"""Smallest half extent of a box, metres: about the noise of the cloud."""


def cover(points: Array, budget: int, settings: ShapeSettings) -> list[Box]:
    """Cover points (n, 3) with at most about ``budget`` oriented boxes.

    Pieces farther apart than ``settings.clutter_gap`` get boxes of their own; then the box with the largest volume is
    split in two across its longest axis, again and again, until the budget is used or nothing is worth splitting.
    """
    if not len(points) or budget < 1:
        return []
    label = pieces(points, settings.clutter_gap)
    sizes = np.bincount(label)
    kept = [np.flatnonzero(label == k) for k in np.argsort(-sizes, kind="stable")[:budget]]
    heap: list[tuple[float, int, npt.NDArray[np.int64], Box]] = []
    for number, rows in enumerate(kept):
        if len(rows) >= settings.min_clutter_points:
            box = bounding_box(points[rows])
            heapq.heappush(heap, (-_waste(box), number, rows, box))
    number = len(heap)
    done: list[Box] = []
    while heap and len(heap) + len(done) < budget:
        waste, _, rows, box = heapq.heappop(heap)
        if -waste < 1e-5 or len(rows) < 2 * settings.min_clutter_points:
            done.append(box)
            continue
        axis = box.rotation[:, int(np.argmax(box.half_extents))]
        position = points[rows] @ axis
        right = position > (position.min() + position.max()) / 2
        for part in (rows[right], rows[~right]):
            number += 1
            part_box = bounding_box(points[part])
            heapq.heappush(heap, (-_waste(part_box), number, part, part_box))
    return done + [entry[3] for entry in heap]


def pieces(points: Array, gap: float) -> npt.NDArray[np.int32]:
    """Number (n,) of the piece each point belongs to: points within ``gap`` metres hang together."""
    cubes, cube = np.unique(np.floor(points / (gap / 2)).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cubes).query_pairs(2.0, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cubes), len(cubes)))
    return np.asarray(connected_components(links, directed=False)[1][cube.ravel()], dtype=np.int32)


def bounding_box(points: Array) -> Box:
    """A box (oriented along the principal axes) that holds all points (n, 3)."""
    center = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - center).T) if len(points) > 1 else np.eye(3))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    local = (points - center) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(center + axes @ ((low + high) / 2), np.maximum((high - low) / 2, THINNEST), axes)


def _waste(box: Box) -> float:
    """Volume of a box, cubic metres, with its thickness counted as at least a centimetre."""
    return float(8 * np.prod(np.maximum(box.half_extents, 0.005)))
