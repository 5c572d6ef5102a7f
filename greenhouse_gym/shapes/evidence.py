"""Assignment of cloud points to the shapes that explain them, and to the skin of tomatoes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, distance_to_shapes

SHELL = 0.004
"""Distance in metres from a shape's surface within which points belong to it."""

Mask = npt.NDArray[np.bool_]

_COLUMN = 0.03  # metres: side of the columns in which points are searched
_NOISE = 0.0015  # metres that points may stand out of a fruit and still be skin
_ALIGNMENT = 0.9  # cosine between a point's normal and the sphere's above which it is skin
_MAX_DISTANCE = 0.008  # metres from a fruit at which aligned points are still skin, as a distant camera sees it


class Evidence(NamedTuple):
    """The shape nearest to each point of a cloud.

    Attributes:
        owner: (n,) index of the shape, or -1 where none is within reach.
        residual: (n,) signed distance from its surface in metres, negative inside; NaN where no shape is within reach.
    """

    owner: npt.NDArray[np.int32]
    residual: Array


def nearest_shapes(points: Array, shapes: Sequence[Shape], reach: float) -> Evidence:
    """Assign each point (n, 3) to the nearest shape whose surface is within ``reach`` metres, or that contains it."""
    owner, residual = np.full(len(points), -1, dtype=np.int32), np.full(len(points), np.nan)
    columns = _Columns(points)
    for index, shape in enumerate(shapes):  # shapes are far from nearly all points: search a box around each
        low, high = _bounds(shape, reach)
        rows = columns.near(low, high)
        rows = rows[((points[rows] >= low) & (points[rows] <= high)).all(axis=1)]
        distance = distance_to_shapes(points[rows], [shape])[:, 0]
        nearer = (distance <= reach) & ~(distance >= residual[rows])
        owner[rows[nearer]], residual[rows[nearer]] = index, distance[nearer]
    return Evidence(owner, residual)


class _Columns:
    """Points (n, 3) by square columns through the row, from the aisle to the other one."""

    def __init__(self, points: Array):
        self._first = points[:, 1:].min(axis=0) if len(points) else np.zeros(2)
        cells = self._cells(points[:, 1:])
        self._last = cells.max(axis=0, initial=0)
        keys = cells @ [self._last[1] + 1, 1]
        self._order = np.argsort(keys, kind="stable")
        self._keys = keys[self._order]

    def near(self, low: Array, high: Array) -> npt.NDArray[np.int64]:
        """Return the rows of all points in the columns that a box from ``low`` to ``high`` (3,) meets."""
        (y, z), (last_y, last_z) = np.clip(self._cells(np.array([low, high])[:, 1:]), 0, self._last)
        starts = np.arange(y, last_y + 1) * (self._last[1] + 1)
        firsts = np.searchsorted(self._keys, starts + z)
        ends = np.searchsorted(self._keys, starts + last_z, "right")
        return np.concatenate([self._order[first:end] for first, end in zip(firsts, ends, strict=True)])

    def _cells(self, points: Array) -> npt.NDArray[np.int64]:
        """Return the columns (n, 2) of points (n, 2) along the row and up."""
        return np.floor((points - self._first) / _COLUMN).astype(np.int64)


def _bounds(shape: Shape, margin: float) -> tuple[Array, Array]:
    """Return the corners (3,) and (3,) of an axis-aligned box around a shape and ``margin`` metres around it."""
    if isinstance(shape, Box):
        half = np.abs(shape.rotation) @ shape.half_extents + margin
        return shape.center - half, shape.center + half
    reach = float(shape.semi_axes.max()) if isinstance(shape, Ellipsoid) else shape.radius
    ends = np.array([shape.start, shape.end] if isinstance(shape, Capsule) else [shape.center])
    return ends.min(axis=0) - reach - margin, ends.max(axis=0) + reach + margin


def skin_mask(points: Array, tomatoes: Sequence[Tomato]) -> Mask:
    """Return which points (n, 3) lie within noise of a tomato's surface."""
    return nearest_shapes(points, [tomato.shape for tomato in tomatoes], _NOISE).owner >= 0


def noisy_skin_mask(points: Array, normals: Array, tomatoes: Sequence[Tomato]) -> Mask:
    """Return which points (n, 3) with normals (n, 3) are skin of a tomato under strong sensor noise."""
    owner = nearest_shapes(points, [tomato.shape for tomato in tomatoes], _MAX_DISTANCE).owner
    return (owner >= 0) & _aligned(points, normals, tomatoes, owner)


def off_skin_mask(points: Array, normals: Array, tomatoes: Sequence[Tomato]) -> Mask:
    """Return which points (n, 3) with normals (n, 3) are not skin of a tomato; a stem in front of it stands out."""
    owner, residual = nearest_shapes(points, [tomato.shape for tomato in tomatoes], SHELL)
    return (owner < 0) | (~_aligned(points, normals, tomatoes, owner) & (residual > _NOISE))


def _aligned(points: Array, normals: Array, tomatoes: Sequence[Tomato], owner: npt.NDArray[np.int32]) -> Mask:
    """Return which points (n, 3) face away from the center of the tomato that owns them."""
    on = np.flatnonzero(owner >= 0)
    outwards = points[on] - np.array([t.center for t in tomatoes]).reshape(-1, 3)[owner[on]]
    aligned = np.zeros(len(points), dtype=np.bool_)
    aligned[on] = (outwards * normals[on]).sum(axis=1) > _ALIGNMENT * np.linalg.norm(outwards, axis=1)
    return aligned
