"""Clutter: what no tomato and no stem explains, covered by few oriented boxes.

Leaves are flat, so flat patches of smooth surfaces get boxes first; what these do not cover gets boxes by nearness.
Boxes that claim empty space are split until they claim hardly any. Then neighbors are joined, those first whose common
box claims least, until no more boxes are left than wanted.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Box
from greenhouse_gym.reconstruction.point_clouds import means_by_voxel
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.patches import flat_patches, lumps
from greenhouse_gym.shapes.settings import ShapeSettings

THINNEST = 0.0025
"""Smallest half extent of a box, metres: about the noise of the cloud."""

_TOLERATED = 0.15  # share of a box's surface that may be empty
_OPEN = 2e-4  # weight, in square metres of empty surface, of a point that a box should not hold
_FEWEST = 10  # boxes that any cloud may have
_MOST_SPLIT = 3  # so many times the wanted number of boxes are made before they are joined
_NEIGHBORS = 6  # neighbors that a box may be joined with, itself counted
_HELD, _FEWEST_HELD = 0.001, 3  # metres inside a box, and so many, that points must be to be cut out of it
_HELPS = 0.8  # most of these points that the parts of a cut box may hold
_MOST_CUTS, _FEWEST_CUT = 4, 5  # most cuts of one box, one after the other, and cells that a part of it must have
_CUTS = (0.3, 0.4, 0.5, 0.6, 0.7)  # where along its axes a box may be split


class _Bounds(NamedTuple):
    """Center (3,), half extents (3,) and rotation (3, 3) of a box; thousands are tried, so none is checked yet."""

    center: Array
    half_extents: Array
    rotation: Array


class _Cloud(NamedTuple):
    """Cells (n, 3) to be covered, and points that no box is to hold."""

    centers: Array
    open: cKDTree


class _Piece(NamedTuple):
    """Points, their box, how much of its surface (square metres) is far from all of them, and as a share."""

    rows: npt.NDArray[np.int64]
    bounds: _Bounds
    claimed: float
    share: float


def cover(
    points: Array, normals: Array, budget: int, settings: ShapeSettings, open_points: Array | None = None
) -> list[Box]:
    """Cover points with as many oriented boxes as they need, but about ``budget`` at most.

    Specks are left out: a handful of cells with points in them is noise.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        budget: Most boxes; see `box_budget`.
        settings: All settings.
        open_points: (k, 3) points that were seen and belong to something else, fruit for instance: no box may hold them
            if it can be helped.
    """
    if not len(points) or budget < 1:
        return []
    centers, facing = _cells(points, normals, settings.clutter_cell)
    cloud = _Cloud(centers, cKDTree(open_points if open_points is not None else np.zeros((0, 3))))
    found = [_boxed(cloud, rows, settings) for rows in flat_patches(centers, facing, settings)]
    missed = np.flatnonzero(
        nearest_shapes(centers, [Box(*piece.bounds) for piece in found], settings.clutter_near).owner < 0
    )
    found += [_boxed(cloud, missed[rows], settings) for rows in lumps(centers[missed], settings)]
    pieces = _exact(cloud, found, _MOST_SPLIT * budget, settings)
    fewer = [part for piece in _fewer(cloud, pieces, budget, settings) for part in _cut_clear(cloud, piece, settings)]
    return [Box(*piece.bounds) for piece in fewer]


def box_budget(points: Array, settings: ShapeSettings) -> int:
    """How many boxes points (n, 3) may have: by their area, so that dense and high foliage gets more."""
    area = len(np.unique(np.floor(points / settings.clutter_cell), axis=0)) * settings.clutter_cell**2
    return max(_FEWEST, round(settings.clutter_per_area * area))


def _exact(cloud: _Cloud, pieces: Sequence[_Piece], most: int, settings: ShapeSettings) -> list[_Piece]:
    """Split, again and again, the piece that claims most empty space, until they claim hardly any or are too many."""
    number = itertools.count()  # settles ties
    heap = [(-piece.claimed, next(number), piece) for piece in pieces]
    heapq.heapify(heap)
    done: list[_Piece] = []
    while heap and len(heap) + len(done) < most:
        piece = heapq.heappop(heap)[-1]
        parts = _split(cloud, piece, settings) if piece.share > _TOLERATED else None
        if parts is None:
            done.append(piece)
            continue
        for part in parts:
            heapq.heappush(heap, (-part.claimed, next(number), part))
    return done + [piece for _, _, piece in heap]


def _fewer(cloud: _Cloud, pieces: Sequence[_Piece], budget: int, settings: ShapeSettings) -> Iterable[_Piece]:
    """Join neighbors until the budget is kept, and as long as it costs hardly anything.

    It is always the two whose common box claims least beyond their own.
    """
    alive = dict(enumerate(pieces))
    if len(alive) < 2:
        return pieces
    centers = np.array([piece.bounds.center for piece in pieces])
    nearest = cKDTree(centers).query(centers, k=min(_NEIGHBORS, len(pieces)))[1]
    near: dict[int, set[int]] = {i: set() for i in alive}
    for i, j in [(i, j) for i, row in enumerate(nearest.tolist()) for j in row if i != j]:
        near[i].add(j)
        near[j].add(i)

    def joined(i: int, j: int) -> tuple[float, int, int, _Piece]:
        union = _boxed(cloud, np.concatenate([alive[i].rows, alive[j].rows]), settings)
        return union.claimed - alive[i].claimed - alive[j].claimed, i, j, union

    heap = [joined(i, j) for i in near for j in near[i] if i < j]
    heapq.heapify(heap)
    while heap and (len(alive) > budget or heap[0][0] < settings.clutter_claim):
        _, i, j, union = heapq.heappop(heap)
        if i not in alive or j not in alive:
            continue
        del alive[i], alive[j]
        new = len(near)
        alive[new], near[new] = union, (near[i] | near[j]) & alive.keys()
        for other in near[new]:
            near[other].add(new)
            heapq.heappush(heap, joined(other, new))
    return alive.values()


def _cut_clear(cloud: _Cloud, piece: _Piece, settings: ShapeSettings, cuts: int = _MOST_CUTS) -> list[_Piece]:
    """A piece in parts whose boxes end before the points that they should not hold, or as it is if that does not help.

    It is cut across an axis, at the first or last of these points, where most is left on the clear side; among them,
    where hardly anything would be left.
    """
    held = _held(cloud, piece.bounds)
    if len(held) < _FEWEST_HELD or not cuts:
        return [piece]
    local = (cloud.centers[piece.rows] - piece.bounds.center) @ piece.bounds.rotation
    clear = max([*(local < held.min(axis=0)).T, *(local > held.max(axis=0)).T], key=np.count_nonzero)
    if np.count_nonzero(clear) < _FEWEST_CUT:
        longest = int(piece.bounds.half_extents.argmax())
        clear = local[:, longest] < np.median(held[:, longest])
        if min(np.count_nonzero(clear), np.count_nonzero(~clear)) < _FEWEST_CUT:
            return [piece]
    parts = [
        part
        for rows in (piece.rows[clear], piece.rows[~clear])
        if len(rows) >= _FEWEST_CUT
        for part in _cut_clear(cloud, _boxed(cloud, rows, settings), settings, cuts - 1)
    ]
    return parts if sum(len(_held(cloud, part.bounds)) for part in parts) < _HELPS * len(held) else [piece]


def _held(cloud: _Cloud, box: _Bounds) -> Array:
    """The points (k, 3) well inside a box, in its frame, that it should not hold."""
    near = cloud.open.query_ball_point(box.center, float(np.linalg.norm(box.half_extents))) if cloud.open.n else []
    local = (cloud.open.data[near] - box.center) @ box.rotation
    return np.asarray(local[(np.abs(local) < box.half_extents - _HELD).all(axis=1)])


def _cells(points: Array, normals: Array, cell: float) -> tuple[Array, Array]:
    """Mean point (k, 3) and mean unit normal (k, 3) of the points in each cube of a grid."""
    (means, facing), _ = means_by_voxel(points, cell, points, normals)
    return means, facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)


def _split(cloud: _Cloud, piece: _Piece, settings: ShapeSettings) -> tuple[_Piece, _Piece] | None:
    """The two parts of a piece that together claim least, cut across one of its box's axes."""
    best: tuple[_Piece, _Piece] | None = None
    box = piece.bounds
    local = (cloud.centers[piece.rows] - box.center) @ box.rotation / box.half_extents
    for axis in range(3):
        if box.half_extents[axis] < 2 * settings.clutter_margin:
            continue
        for cut in _CUTS:
            beyond = local[:, axis] > 2 * cut - 1
            if min(np.count_nonzero(beyond), np.count_nonzero(~beyond)) < settings.min_lump_cells:
                continue
            parts = (
                _boxed(cloud, piece.rows[beyond], settings),
                _boxed(cloud, piece.rows[~beyond], settings),
            )
            if best is None or parts[0].claimed + parts[1].claimed < best[0].claimed + best[1].claimed:
                best = parts
    return best


def _boxed(cloud: _Cloud, rows: npt.NDArray[np.int64], settings: ShapeSettings) -> _Piece:
    points = cloud.centers[rows]
    box = _bounds(points)
    surface, areas = _surface(box, settings.clutter_margin)
    far = cKDTree(points).query(surface, distance_upper_bound=settings.clutter_margin)[0] == np.inf
    claimed, area = float(areas[far].sum()), float(areas.sum())
    if cloud.open.n:
        near = cloud.open.query_ball_point(box.center, float(np.linalg.norm(box.half_extents)))
        inside = np.abs((cloud.open.data[near] - box.center) @ box.rotation) < box.half_extents
        claimed += _OPEN * np.count_nonzero(inside.all(axis=1))
    return _Piece(rows, box, claimed, claimed / area)


def _surface(box: _Bounds, spacing: float) -> tuple[Array, Array]:
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


def bounding_box(points: Array) -> Box:
    """A box (oriented along the principal axes) that holds all points (n, 3)."""
    return Box(*_bounds(points))


def _bounds(points: Array) -> _Bounds:
    middle = points.mean(axis=0)
    away = points - middle
    axes = np.linalg.eigh(away.T @ away)[1]
    if axes[:, 0] @ np.cross(axes[:, 1], axes[:, 2]) < 0:
        axes[:, 0] *= -1
    local = away @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    return _Bounds(middle + axes @ ((low + high) / 2), np.maximum((high - low) / 2, THINNEST), axes)
