"""Clutter: what no tomato and no stem explains, covered by few oriented boxes.

Conservative: every point of a piece lies in its box. Not bloated: the box that claims most empty space is split first,
where that leaves the least.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Box
from greenhouse_gym.shapes.settings import ShapeSettings

THINNEST = 0.0025
"""Smallest half extent of a box, metres: about the noise of the cloud."""

_WORTH = 2e-4  # square metres a box must claim wrongly to be split
_CUTS = (0.3, 0.4, 0.5, 0.6, 0.7)  # where along its axes a box may be split


class _Piece(NamedTuple):
    """Points, their box, and how much of the box's surface (square metres) is far from all of them."""

    rows: npt.NDArray[np.int64]
    box: Box
    claimed: float


def cover(points: Array, budget: int, settings: ShapeSettings) -> list[Box]:
    """Cover points (n, 3) with at most about ``budget`` oriented boxes.

    Pieces farther apart than ``settings.clutter_gap`` get boxes of their own; then the box with the largest empty
    surface is split in two, again and again, until the budget is used or nothing is worth splitting.
    """
    if not len(points) or budget < 1:
        return []
    label = pieces(points, settings.clutter_gap)
    sizes = np.bincount(label)
    large = [k for k in np.argsort(-sizes, kind="stable")[:budget] if sizes[k] >= settings.min_clutter_points]
    heap: list[tuple[float, int, _Piece]] = []
    for k in large:
        piece = _boxed(points, np.flatnonzero(label == k), settings)
        heapq.heappush(heap, (-piece.claimed, len(heap), piece))
    number = len(heap)
    done: list[Box] = []
    while heap and len(heap) + len(done) < budget:
        _, _, piece = heapq.heappop(heap)
        parts = _split(points, piece, settings) if piece.claimed > _WORTH else None
        if parts is None:
            done.append(piece.box)
            continue
        for part in parts:
            number += 1
            heapq.heappush(heap, (-part.claimed, number, part))
    return done + [piece.box for _, _, piece in heap]


def _split(points: Array, piece: _Piece, settings: ShapeSettings) -> tuple[_Piece, _Piece] | None:
    """The two parts of a piece that together claim least, cut across one of its box's axes."""
    best: tuple[_Piece, _Piece] | None = None
    local = (points[piece.rows] - piece.box.center) @ piece.box.rotation / piece.box.half_extents
    for axis in range(3):
        if piece.box.half_extents[axis] < 2 * settings.clutter_margin:
            continue
        for cut in _CUTS:
            beyond = local[:, axis] > 2 * cut - 1
            if min(np.count_nonzero(beyond), np.count_nonzero(~beyond)) < settings.min_clutter_points:
                continue
            parts = (
                _boxed(points, piece.rows[beyond], settings),
                _boxed(points, piece.rows[~beyond], settings),
            )
            if best is None or parts[0].claimed + parts[1].claimed < best[0].claimed + best[1].claimed:
                best = parts
    return best


def _boxed(points: Array, rows: npt.NDArray[np.int64], settings: ShapeSettings) -> _Piece:
    box = bounding_box(points[rows])
    some = points[rows[:: max(1, len(rows) // 500)]]
    surface, areas = _surface(box, settings.clutter_margin)
    far = cKDTree(some).query(surface, distance_upper_bound=settings.clutter_margin)[0] > settings.clutter_margin
    return _Piece(rows, box, float(areas[far].sum()))


def _surface(box: Box, spacing: float) -> tuple[Array, Array]:
    """Points (n, 3) evenly over a box's faces, about ``spacing`` apart, and the area (n,) each stands for."""
    points, areas = [], []
    counts = np.clip(np.ceil(2 * box.half_extents / spacing), 1, 12).astype(int)
    ticks = [(2 * (np.arange(n) + 0.5) / n - 1) * h for n, h in zip(counts, box.half_extents, strict=True)]
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        grid = np.zeros((2, counts[u], counts[v], 3))
        grid[..., axis] = box.half_extents[axis] * np.array([-1.0, 1.0])[:, None, None]
        grid[..., u], grid[..., v] = ticks[u][:, None], ticks[v]
        points.append(grid.reshape(-1, 3))
        areas.append(np.full(grid.size // 3, 4 * box.half_extents[u] * box.half_extents[v] / (counts[u] * counts[v])))
    return box.center + np.concatenate(points) @ box.rotation.T, np.concatenate(areas)


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
