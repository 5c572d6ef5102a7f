"""Leaves as thin boxes: a mesh of a thin, bent, lobed surface cut into flat pieces to collide with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box

TOLERANCE = 0.005
"""Metres from the leaf's surface at which a box's face still counts as on it. All boxes of a leaf together then lie
within 4 mm with 95 % of their faces, and so does the leaf from them."""

_SUNK = 0.003  # metres that the edge of a piece may stick out of its box: boxes that enclose it stick out more
_STRAY = 0.05  # share of a box's faces that may lie farther off than the tolerance
_THINNEST = 0.0005  # metres, half the thickness of a box at least
_CUTS = (-0.4, -0.2, 0.0, 0.2, 0.4)  # where a piece may be cut, in half extents of its box from the middle
_LOOKED_AT = 300  # points of a piece, about, by which the best cut is chosen
_ANGLES = np.arange(24) * np.pi / 48  # radians, directions of a box's longer sides in its plane


def leaf_boxes(vertices: Array, triangles: npt.NDArray[np.int64], tolerance: float = TOLERANCE) -> list[Box]:
    """Cut a leaf into thin boxes that lie on it.

    Each box has the smallest rectangle around a piece of the surface, seen along its thinnest direction, and its depth,
    or 3 mm less at each side where too much of that would lie off the surface. A piece for which neither will do is
    cut in two, so that the boxes around both are as small as they can be.

    Args:
        vertices: (v, 3) metres.
        triangles: (t, 3) indices of vertices.
        tolerance: See `TOLERANCE`; 95 % of each box's faces keep it.

    Raises:
        InvalidValueError: The arrays have other shapes, or name vertices that there are not.
    """
    v, t = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    if v.ndim != 2 or v.shape[1] != 3 or t.ndim != 2 or t.shape[1] != 3 or not np.isfinite(v).all():
        raise InvalidValueError(f"expected vertices (v, 3) and triangles (t, 3), got {v.shape} and {t.shape}")
    if t.size and (t.min() < 0 or t.max() >= len(v)):
        raise InvalidValueError(f"triangles name vertices {t.min()} to {t.max()}, there are {len(v)}")
    if not len(t):
        return []
    points = surface_points(v, t, tolerance / 2)
    tree, boxes, left = cKDTree(points), [], [points]
    while left:
        piece = left.pop()
        box = _box_around(piece)
        within = Box(box.center, np.maximum(box.half_extents - _SUNK, _THINNEST), box.rotation)
        if box.half_extents.max() <= tolerance / 2 or _fits(box, tree, tolerance, _STRAY / 4):
            boxes.append(box)
        elif _fits(within, tree, tolerance, _STRAY):
            boxes.append(within)
        else:
            upper = _best_cut(piece, box, tolerance)
            left += [piece[upper], piece[~upper]]
    return boxes


def surface_points(vertices: Array, triangles: npt.NDArray[np.int64], spacing: float) -> Array:
    """Points (n, 3) on triangles, no farther from each other than about ``spacing``; at least the corners of each."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    longest = np.linalg.norm([b - a, c - b, a - c], axis=-1).max(axis=0)
    steps = np.maximum(np.ceil(longest / spacing), 1).astype(int)
    parts = []
    for count in np.unique(steps):
        own = steps == count
        i, j = (m.reshape(-1) for m in np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij"))
        i, j = i[i + j <= count] / count, j[i + j <= count] / count
        parts.append((a[own, None] + i[:, None] * (b - a)[own, None] + j[:, None] * (c - a)[own, None]).reshape(-1, 3))
    return np.concatenate(parts)


def _box_around(points: Array) -> Box:
    """The box around points whose longer sides enclose the smallest rectangle, the thinnest side last."""
    middle = points.mean(axis=0)
    apart = points - middle
    plane = np.linalg.eigh(apart.T @ apart)[1][:, :0:-1]
    cos, sin = np.cos(_ANGLES), np.sin(_ANGLES)
    along, across = plane @ np.array([cos, sin]), plane @ np.array([-sin, cos])
    k = int((np.ptp(apart @ along, axis=0) * np.ptp(apart @ across, axis=0)).argmin())
    frame = np.column_stack([along[:, k], across[:, k], np.cross(along[:, k], across[:, k])])
    local = apart @ frame
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(middle + frame @ ((low + high) / 2), np.maximum((high - low) / 2, _THINNEST), frame)


def _best_cut(piece: Array, box: Box, tolerance: float) -> npt.NDArray[np.bool_]:
    """Which points (n,) of a piece lie beyond the cut that leaves the least room in the boxes around both parts.

    Depth counts beside the tolerance: a deep box is as bad as a wide one.
    """
    local = (piece - box.center) @ box.rotation
    some = local[:: 1 + len(local) // _LOOKED_AT]
    best = (np.inf, int(box.half_extents.argmax()), 0.0)
    for axis in np.flatnonzero(box.half_extents[:2] > tolerance / 2):
        for at in box.half_extents[axis] * np.array(_CUTS):
            beyond = some[:, axis] > at
            if not beyond.all() and beyond.any():
                halves = [_box_around(part).half_extents for part in (some[beyond], some[~beyond])]
                room = sum(half[0] * half[1] * (2 * half[2] + tolerance) for half in halves)
                best = min(best, (float(room), int(axis), float(at)))
    return np.asarray(local[:, best[1]] > best[2])


def _fits(box: Box, tree: cKDTree, tolerance: float, stray: float) -> bool:
    """Whether nearly all of both larger faces of a box lie near the surface."""
    sides = [np.linspace(-half, half, 2 + int(2 * half / tolerance)) for half in box.half_extents[:2]]
    u, v = (m.reshape(-1) for m in np.meshgrid(*sides))
    faces = np.concatenate([np.column_stack([u, v, np.full(len(u), side * box.half_extents[2])]) for side in (-1, 1)])
    distance, _ = tree.query(box.center + faces @ box.rotation.T, distance_upper_bound=tolerance)
    return bool(np.isinf(distance).mean() <= stray)
