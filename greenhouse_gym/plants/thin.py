"""Leaves as thin boxes: a mesh of a thin, bent, lobed surface cut into flat pieces to collide with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box

TOLERANCE = 0.005
"""Metres from the leaf's surface at which a box's surface still counts as on it. All boxes of a leaf together then lie
within 4 mm with 95 % of their surface."""

_STRAY = 0.05  # share of a box's surface that may lie farther off
_THINNEST = 0.0005  # metres, half the thickness of a box at least


def leaf_boxes(vertices: Array, triangles: npt.NDArray[np.int64], tolerance: float = TOLERANCE) -> list[Box]:
    """Cut a leaf into thin boxes that cover it and claim little more.

    Each box encloses a piece of the surface, in the directions of its extent; a piece that is too bent or fills too
    little of its box is halved across its longer side.

    Args:
        vertices: (v, 3) metres.
        triangles: (t, 3) indices of vertices.
        tolerance: See `TOLERANCE`; nineteen twentieths of each box's surface keep it.

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
        if _fits(box, tree, tolerance) or box.half_extents.max() <= tolerance / 2:
            boxes.append(box)
            continue
        axis = int(box.half_extents.argmax())
        upper = (piece - box.center) @ box.rotation[:, axis] > 0
        left += [half for half in (piece[upper], piece[~upper]) if len(half)]
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
    """The box around points in the directions of their extent, the thinnest last."""
    middle = points.mean(axis=0)
    frame = np.linalg.eigh(np.cov((points - middle).T) if len(points) > 1 else np.eye(3))[1][:, ::-1]
    frame = frame * np.array([1.0, 1.0, np.linalg.det(frame)])
    local = (points - middle) @ frame
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(middle + frame @ ((low + high) / 2), np.maximum((high - low) / 2, _THINNEST), frame)


def _fits(box: Box, tree: cKDTree, tolerance: float) -> bool:
    """Whether a box is thin and nearly all of its middle plane lies near the surface."""
    if 2 * box.half_extents[2] > tolerance:
        return False
    sides = [np.linspace(-half, half, 2 + int(half / tolerance)) for half in box.half_extents[:2]]
    u, v = (m.reshape(-1) for m in np.meshgrid(*sides))
    plane = np.column_stack([u, v, np.zeros(len(u))])
    distance, _ = tree.query(box.center + plane @ box.rotation.T, distance_upper_bound=tolerance)
    return bool(np.isinf(distance).mean() <= _STRAY)
