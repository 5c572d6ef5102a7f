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
    order = np.argsort(points[:, 1], kind="stable")
    along = points[order, 1]
    for index, shape in enumerate(shapes):  # shapes are far from nearly all points: search a box around each
        low, high = _bounds(shape, reach)
        rows = order[np.searchsorted(along, low[1]) : np.searchsorted(along, high[1], "right")]
        rows = rows[((points[rows] >= low) & (points[rows] <= high)).all(axis=1)]
        distance = distance_to_shapes(points[rows], [shape])[:, 0]
        nearer = (distance <= reach) & ~(distance >= residual[rows])
        owner[rows[nearer]], residual[rows[nearer]] = index, distance[nearer]
    return Evidence(owner, residual)


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
