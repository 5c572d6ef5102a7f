"""Clutter: oriented boxes over the points that belong to neither tomatoes nor stems.

Leaves are flat, so flat patches of smooth surfaces get boxes first; the remaining cells get boxes by proximity. Boxes
that enclose much empty surface are split. Then neighbors are merged, those whose common box adds the least empty
surface first, until the budget is met.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Box
from greenhouse_gym.geometry.point_clouds import means_by_voxel
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.settings import ShapeSettings

CELL = 0.005
"""Side in metres of the cells that boxes are fitted to."""

_SMOOTH = 0.9  # cosine between the normals of neighbors on one smooth surface
_ALIGNED = 0.8  # cosine between the normals of a flat patch's cells and the plane's
_MIN_PATCH_CELLS = 30  # smaller patches are no leaves
_MAX_GAP = 0.012  # metres between cells of one cluster
_MAX_PLANES = 40  # cells of a surface whose planes are tried

COVERED = 0.007
"""Distance in metres from a box within which points are covered by it."""

_MIN_HALF_EXTENT = 0.0025  # metres: about the noise of the cloud
_MAX_EMPTY = 0.15  # fraction of a box's surface that may be empty
_EXCLUDED_WEIGHT = 2e-4  # square metres of empty surface that an excluded point in a box counts for
_MIN_BUDGET = 10  # boxes that any cloud may have
_MAX_MERGED_EMPTY = 0.5  # fraction of a box's surface: no budget justifies a box that is mostly empty
_MAX_ADDED = 0.02  # square metres of empty surface: nor a plank across two rails, which are far from each other
_MAX_SPLIT = 3  # multiple of the budget up to which boxes are split before they are merged
_NEIGHBORS = 6  # boxes among which merges are tried, itself counted
_DEPTH, _MIN_INSIDE = 0.001, 3  # metres inside a box, and number, of excluded points that make it be cut
_MAX_REMAINING = 0.8  # fraction of these points that the parts of a cut box may contain
_MAX_CUTS, _MIN_CUT_CELLS = 4, 5  # successive cuts of one box, and cells that a part of it must have
_SPLITS = (0.3, 0.4, 0.5, 0.6, 0.7)  # positions along its axes at which a box may be split

Rows = npt.NDArray[np.int64]


def flat_patches(centers: Array, normals: Array, flatness: float) -> list[Rows]:
    """Return the rows of the cells of each flat patch: neighbors with similar normals near one plane.

    The largest flat part is removed from every smooth surface until only small pieces are left.

    Args:
        centers: (n, 3) mean point of each cell, metres.
        normals: (n, 3) mean unit normal of each cell.
        flatness: Largest distance of a cell from its plane, metres.
    """
    pairs = cKDTree(centers).query_pairs(1.8 * CELL, output_type="ndarray")
    one, two = pairs.T
    apart = centers[two] - centers[one]
    off_plane = np.abs((apart * (normals[one] + normals[two])).sum(axis=1)) / 2
    smooth = (normals[one] * normals[two]).sum(axis=1) > _SMOOTH
    smooth &= off_plane < 0.5 * np.linalg.norm(apart, axis=1) + CELL / 5
    links = _links(len(centers), pairs[smooth])
    surfaces = _connected(links, np.arange(len(centers)), _MIN_PATCH_CELLS)
    patches = []
    while surfaces:
        rows = surfaces.pop()
        patch = _connected(links, rows[_in_best_plane(centers[rows], normals[rows], flatness)], 1)[0]
        if len(patch) >= _MIN_PATCH_CELLS:
            patches.append(patch)
        surfaces += _connected(links, np.setdiff1d(rows, patch), _MIN_PATCH_CELLS)
    return patches


def clusters(centers: Array, min_cells: int) -> list[Rows]:
    """Return the rows of the cells (n, 3) of each cluster of at least ``min_cells`` cells."""
    if not len(centers):
        return []
    pairs = cKDTree(centers).query_pairs(_MAX_GAP, output_type="ndarray")
    return _connected(_links(len(centers), pairs), np.arange(len(centers)), min_cells)


def _in_best_plane(centers: Array, normals: Array, flatness: float) -> npt.NDArray[np.bool_]:
    """Return which cells (n,) lie in the plane through one cell that contains most cells, after a fit to these."""
    seeds = np.linspace(0, len(centers) - 1, min(len(centers), _MAX_PLANES)).astype(int)
    height = normals[seeds] @ centers.T - (normals[seeds] * centers[seeds]).sum(axis=1)[:, None]
    inside = (np.abs(height) < flatness) & (normals[seeds] @ normals.T > _ALIGNED)
    best = inside[np.argmax(inside.sum(axis=1))]
    middle = centers[best].mean(axis=0)
    normal = np.linalg.svd(centers[best] - middle, full_matrices=False)[2][-1]
    fitted = np.abs((centers - middle) @ normal) < flatness
    fitted &= np.abs(normals @ normal) > _ALIGNED
    return np.asarray(fitted if np.count_nonzero(fitted) > np.count_nonzero(best) else best)


def _links(count: int, pairs: Rows) -> csr_array:
    return coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()


def _connected(links: csr_array, rows: Rows, min_size: int) -> list[Rows]:
    """Return the connected parts of some rows of a graph with at least ``min_size`` rows, largest first."""
    label = connected_components(links[rows][:, rows], directed=False)[1]
    parts = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    return [rows[part] for part in sorted(parts, key=len, reverse=True) if len(part) >= min_size]


class BoxBounds(NamedTuple):
    """Center (3,), half extents (3,) and rotation (3, 3) of a box; thousands are tried, so none is validated yet."""

    center: Array
    half_extents: Array
    rotation: Array


class _Cells(NamedTuple):
    """Centers (n, 3) of cells to be covered, and the tree of points that no box should contain."""

    centers: Array
    excluded: cKDTree


class _Piece(NamedTuple):
    """Rows of cells, their box, and how much of its surface is empty: in square metres and as a fraction.

    Excluded points in the box add to the square metres.
    """

    rows: Rows
    bounds: BoxBounds
    empty_area: float
    empty_fraction: float


def cover_with_boxes(
    points: Array, normals: Array, budget: int, settings: ShapeSettings, excluded: Array | None = None
) -> list[Box]:
    """Cover points with as many oriented boxes as they need, up to about ``budget``.

    Small clusters of cells are noise and are left out.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        budget: Number of boxes; see `box_budget`.
        settings: All settings.
        excluded: (k, 3) points of other things, fruit for instance, that boxes should not contain.
    """
    if not len(points) or budget < 1:
        return []
    (centers, facing), _ = means_by_voxel(points, CELL, points, normals)
    facing = facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
    cells = _Cells(centers, cKDTree(excluded if excluded is not None else np.zeros((0, 3))))
    pieces = [_piece(cells, rows, settings) for rows in flat_patches(centers, facing, settings.clutter_flatness)]
    covered = nearest_shapes(centers, [Box(*piece.bounds) for piece in pieces], COVERED).owner >= 0
    missed = np.flatnonzero(~covered)
    pieces += [_piece(cells, missed[rows], settings) for rows in clusters(centers[missed], settings.clutter_min_cells)]
    pieces = _split_pieces(cells, pieces, _MAX_SPLIT * budget, settings)
    merged = _merge_pieces(cells, pieces, budget, settings)
    return [Box(*part.bounds) for piece in merged for part in _cut_excluded(cells, piece, settings)]


def box_budget(points: Array, settings: ShapeSettings) -> int:
    """Return the number of boxes for points (n, 3), in proportion to their area, so that dense foliage gets more."""
    area = len(np.unique(np.floor(points / CELL), axis=0)) * CELL**2
    return max(_MIN_BUDGET, round(settings.clutter_per_area * area))


def _split_pieces(cells: _Cells, pieces: Sequence[_Piece], limit: int, settings: ShapeSettings) -> list[_Piece]:
    """Split pieces, the emptiest first, until all are below `_MAX_EMPTY` or there are ``limit`` of them."""
    number = itertools.count()  # breaks ties
    heap = [(-piece.empty_area, next(number), piece) for piece in pieces]
    heapq.heapify(heap)
    done: list[_Piece] = []
    while heap and len(heap) + len(done) < limit:
        piece = heapq.heappop(heap)[-1]
        parts = _split(cells, piece, settings) if piece.empty_fraction > _MAX_EMPTY else None
        if parts is None:
            done.append(piece)
            continue
        for part in parts:
            heapq.heappush(heap, (-part.empty_area, next(number), part))
    return done + [piece for _, _, piece in heap]


def _merge_pieces(cells: _Cells, pieces: Sequence[_Piece], budget: int, settings: ShapeSettings) -> Iterable[_Piece]:
    """Merge neighbors until the budget is met, and further while it adds hardly any empty surface.

    The two whose common box adds the least empty surface are merged first.
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

    def merged(i: int, j: int) -> tuple[float, int, int, _Piece]:
        union = _piece(cells, np.concatenate([alive[i].rows, alive[j].rows]), settings)
        return union.empty_area - alive[i].empty_area - alive[j].empty_area, i, j, union

    heap = [merged(i, j) for i in near for j in near[i] if i < j]
    heapq.heapify(heap)
    while heap and (len(alive) > budget or heap[0][0] < settings.clutter_merge_area):
        added, i, j, union = heapq.heappop(heap)
        if i not in alive or j not in alive:
            continue
        wasteful = added > _MAX_ADDED or union.empty_fraction > _MAX_MERGED_EMPTY
        if added >= settings.clutter_merge_area and wasteful:
            continue
        del alive[i], alive[j]
        new = len(near)
        alive[new], near[new] = union, (near[i] | near[j]) & alive.keys()
        for other in near[new]:
            near[other].add(new)
            heapq.heappush(heap, merged(other, new))
    return alive.values()


def _cut_excluded(cells: _Cells, piece: _Piece, settings: ShapeSettings, cuts: int = _MAX_CUTS) -> list[_Piece]:
    """Cut a piece into parts whose boxes contain fewer excluded points, or return it whole if that does not help.

    It is cut across an axis at the first or last excluded point, where that leaves the most cells on the free side, or
    among the excluded points where hardly any cells would be left.
    """
    inside = _excluded_inside(cells, piece.bounds)
    if len(inside) < _MIN_INSIDE or not cuts:
        return [piece]
    local = (cells.centers[piece.rows] - piece.bounds.center) @ piece.bounds.rotation
    free = max([*(local < inside.min(axis=0)).T, *(local > inside.max(axis=0)).T], key=np.count_nonzero)
    if np.count_nonzero(free) < _MIN_CUT_CELLS:
        longest = int(piece.bounds.half_extents.argmax())
        free = local[:, longest] < np.median(inside[:, longest])
        if min(np.count_nonzero(free), np.count_nonzero(~free)) < _MIN_CUT_CELLS:
            return [piece]
    parts = [
        part
        for rows in (piece.rows[free], piece.rows[~free])
        if len(rows) >= _MIN_CUT_CELLS
        for part in _cut_excluded(cells, _piece(cells, rows, settings), settings, cuts - 1)
    ]
    remaining = sum(len(_excluded_inside(cells, part.bounds)) for part in parts)
    return parts if remaining < _MAX_REMAINING * len(inside) else [piece]


def _near_excluded(cells: _Cells, box: BoxBounds) -> Array:
    """Return the excluded points (k, 3) within a box's bounding sphere, in the box's frame."""
    if not cells.excluded.n:
        return np.zeros((0, 3))
    near = cells.excluded.query_ball_point(box.center, float(np.linalg.norm(box.half_extents)))
    return np.asarray((cells.excluded.data[near] - box.center) @ box.rotation)


def _excluded_inside(cells: _Cells, box: BoxBounds) -> Array:
    """Return the excluded points (k, 3) well inside a box, in its frame."""
    local = _near_excluded(cells, box)
    return np.asarray(local[(np.abs(local) < box.half_extents - _DEPTH).all(axis=1)])


def _split(cells: _Cells, piece: _Piece, settings: ShapeSettings) -> tuple[_Piece, _Piece] | None:
    """Return the two parts of a piece with the least empty surface, split across one of its box's axes."""
    best: tuple[_Piece, _Piece] | None = None
    box = piece.bounds
    local = (cells.centers[piece.rows] - box.center) @ box.rotation / box.half_extents
    for axis in range(3):
        if box.half_extents[axis] < 2 * settings.clutter_margin:
            continue
        for split in _SPLITS:
            above = local[:, axis] > 2 * split - 1
            if min(np.count_nonzero(above), np.count_nonzero(~above)) < settings.clutter_min_cells:
                continue
            parts = _piece(cells, piece.rows[above], settings), _piece(cells, piece.rows[~above], settings)
            if best is None or _empty_area(parts) < _empty_area(best):
                best = parts
    return best


def _empty_area(parts: tuple[_Piece, _Piece]) -> float:
    return parts[0].empty_area + parts[1].empty_area


def _piece(cells: _Cells, rows: Rows, settings: ShapeSettings) -> _Piece:
    points = cells.centers[rows]
    box = bounding_box(points)
    surface, areas = _sample_surface(box, settings.clutter_margin)
    empty = cKDTree(points).query(surface, distance_upper_bound=settings.clutter_margin)[0] == np.inf
    empty_area, area = float(areas[empty].sum()), float(areas.sum())
    inside = (np.abs(_near_excluded(cells, box)) < box.half_extents).all(axis=1)
    empty_area += _EXCLUDED_WEIGHT * np.count_nonzero(inside)
    return _Piece(rows, box, empty_area, empty_area / area)


def _sample_surface(box: BoxBounds, spacing: float) -> tuple[Array, Array]:
    """Return points (n, 3) evenly over a box's faces, about ``spacing`` apart, and the area (n,) of each."""
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


def bounding_box(points: Array) -> BoxBounds:
    """Return a box along the principal axes that contains all points (n, 3)."""
    middle = points.mean(axis=0)
    offset = points - middle
    axes = np.linalg.eigh(offset.T @ offset)[1]
    if axes[:, 0] @ np.cross(axes[:, 1], axes[:, 2]) < 0:
        axes[:, 0] *= -1
    local = offset @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    return BoxBounds(middle + axes @ ((low + high) / 2), np.maximum((high - low) / 2, _MIN_HALF_EXTENT), axes)
