"""Convex shapes of plant organs to collide with; leaves, thin bent lobed surfaces, are cut into thin boxes.

The ground truth of a simulated recording is one ``.npz`` file of such shapes as tables, without pickles.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.common.array_files import read_arrays
from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.crops.crop import PlantRow
from greenhouse_gym.crops.organs import THIN_KINDS, Organ
from greenhouse_gym.crops.shape_tables import ShapeTables, as_tables, from_tables
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, Capsule, Shape

TOLERANCE = 0.005
"""Distance from the leaf's surface within which a box's face counts as on it, metres. With this value, 95 % of the
faces of a leaf's boxes lie within 4 mm of it, and 95 % of the leaf lies within 4 mm of them."""

_INSET = 0.003  # metres by which the edge of a piece may protrude from its box; enclosing boxes protrude more
_PARTS = 6  # of a box's faces, which are looked up one after the other
_MAX_OFF = 0.05  # fraction of a box's faces that may lie beyond the tolerance
_MIN_HALF = 0.0005  # minimum half thickness of a box, metres
_CUTS = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])  # positions of cuts, in half extents of the box from its center
_SAMPLES = 300  # approximate number of points by which the best cut is chosen
_ANGLES = np.arange(24) * np.pi / 48  # radians, directions of a box's longer sides in its plane
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)

TRUTH = "truth.npz"
MAX_BYTES = 50_000_000  # that such a file may unpack to; a row of 5 m takes about one million
_BEHIND = "behind_"


@lru_cache(maxsize=4)
def truth_of(row: PlantRow, tolerance: float = TOLERANCE) -> PlantRow:
    """Return a row as shapes to collide with: spheres or ellipsoids, capsules, and thin boxes.

    An analytic row consists of such shapes already. In a row of meshes, fruit and stems are known as shapes; leaves,
    calyces and flowers are cut into thin boxes, which takes some 40 ms each. The row behind, which no
    arm reaches, keeps its meshes.

    Args:
        row: The row.
        tolerance: Distance in metres from a leaf at which its boxes may lie, as in `leaf_boxes`. Twice the distance
            gives about half as many boxes.
    """
    if not row.organs:
        return row
    clutter = (shape for organ in row.organs for shape in _clutter_of(organ, tolerance))
    return replace(row, clutter=(*row.clutter, *clutter))


def _clutter_of(organ: Organ, tolerance: float) -> list[Shape]:
    """Return the shapes of an organ that is neither fruit nor stem, else none."""
    if organ.kind in THIN_KINDS:
        return list(leaf_boxes(organ.vertices, organ.triangles, tolerance))
    if organ.kind == "petiole" and organ.axis is not None:
        return [Capsule(a[:3], b[:3], max((a[3] + b[3]) / 2, 1e-4)) for a, b in pairwise(organ.axis)]
    if organ.kind == "gutter":
        low, high = organ.vertices.min(axis=0), organ.vertices.max(axis=0)
        return [Box((low + high) / 2, (high - low) / 2, np.eye(3))]
    return []


def leaf_boxes(vertices: Array, triangles: npt.NDArray[np.int64], tolerance: float = TOLERANCE) -> list[Box]:
    """Cut a leaf into thin boxes that lie on it.

    Each box has the depth of a piece of the surface and, seen along its thinnest direction, its smallest bounding
    rectangle; or 3 mm less at each side if too much of that would lie off the surface. A piece for which neither
    suffices is cut in two where the boxes around both parts are smallest.

    Args:
        vertices: (v, 3) metres.
        triangles: (t, 3) indices of vertices.
        tolerance: See `TOLERANCE`; 95 % of each box's faces keep it.

    Raises:
        InvalidValueError: The arrays have other shapes, or the triangles refer to missing vertices.
    """
    v, t = np.asarray(vertices, dtype=np.float64), np.asarray(triangles)
    if v.ndim != 2 or v.shape[1] != 3 or t.ndim != 2 or t.shape[1] != 3 or not np.isfinite(v).all():
        raise InvalidValueError(f"expected vertices (v, 3) and triangles (t, 3), got {v.shape} and {t.shape}")
    if t.size and (t.min() < 0 or t.max() >= len(v)):
        raise InvalidValueError(f"triangles refer to vertices {t.min()} to {t.max()} of {len(v)}")
    if not len(t):
        return []
    points = surface_points(v, t, tolerance / 2)
    tree, boxes, pending = cKDTree(points), [], [points]
    while pending:
        piece = pending.pop()
        box = _box_around(piece)
        within = Box(box.center, np.maximum(box.half_extents - _INSET, _MIN_HALF), box.rotation)
        if box.half_extents.max() <= tolerance / 2 or _fits(box, tree, tolerance, _MAX_OFF / 4):
            boxes.append(box)
        elif _fits(within, tree, tolerance, _MAX_OFF):
            boxes.append(within)
        else:
            upper = _best_cut(piece, box, tolerance)
            pending += [piece[upper], piece[~upper]]
    return boxes


def surface_points(vertices: Array, triangles: npt.NDArray[np.int64], spacing: float) -> Array:
    """Return points (n, 3) on triangles about ``spacing`` apart, including all corners."""
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
    """Return the box around points whose longer sides form the smallest rectangle; its thinnest side is the last."""
    from greenhouse_gym.crops.cut_kernels import smallest_rectangle

    middle = points.mean(axis=0)
    apart = points - middle
    plane = np.linalg.eigh(apart.T @ apart)[1][:, :0:-1]
    cos, sin = _DIRECTIONS.T
    along, across = plane @ np.array([cos, sin]), plane @ np.array([-sin, cos])
    k = smallest_rectangle(apart @ along, apart @ across)
    frame = np.column_stack([along[:, k], across[:, k], np.cross(along[:, k], across[:, k])])
    local = apart @ frame
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(middle + frame @ ((low + high) / 2), np.maximum((high - low) / 2, _MIN_HALF), frame)


def _best_cut(piece: Array, box: Box, tolerance: float) -> npt.NDArray[np.bool_]:
    """Return which points (n,) of a piece lie beyond the cut that minimizes the boxes around both parts.

    The tolerance is added to the depth, so that deep boxes cost as much as wide ones.
    """
    from greenhouse_gym.crops.cut_kernels import best_cut

    local = (piece - box.center) @ box.rotation
    samples = np.ascontiguousarray(local[:: 1 + len(local) // _SAMPLES])
    axis, position = best_cut(samples, box.half_extents, _CUTS, _DIRECTIONS, tolerance, _MIN_HALF)
    return np.asarray(local[:, axis] > position)


def _fits(box: Box, tree: cKDTree, tolerance: float, max_off: float) -> bool:
    """Return whether nearly all of both larger faces of a box lie near the surface."""
    u, v = (np.linspace(-half, half, 2 + int(2 * half / tolerance)) for half in box.half_extents[:2])
    faces = np.empty((2, len(u), len(v), 3))
    faces[..., 0], faces[..., 1] = u[:, None], v
    faces[0, ..., 2], faces[1, ..., 2] = -box.half_extents[2], box.half_extents[2]
    points, off = box.center + faces.reshape(-1, 3) @ box.rotation.T, 0
    for first in range(_PARTS):  # most boxes are far off, as some of the points show
        distance, _ = tree.query(points[first::_PARTS], distance_upper_bound=tolerance)
        off += int(np.isinf(distance).sum())
        if off / len(points) > max_off:
            return False
    return True


def save_truth(row: PlantRow, path: str | Path) -> Path:
    """Write the collision shapes of a row and of the one behind it."""
    truth = truth_of(row)
    arrays: dict[str, Array] = {"size": np.array([truth.length, float(truth.week)])}
    for prefix, part in (("", truth), (_BEHIND, truth.behind)):
        if part is not None:
            tables = as_tables(part.tomatoes, part.stems, part.clutter)
            arrays |= {prefix + name: table for name, table in zip(ShapeTables._fields, tables, strict=True)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return write_atomically(path, buffer.getvalue())


def load_truth(path: str | Path) -> PlantRow | None:
    """Read a row that `save_truth` wrote; None if the file does not exist.

    Raises:
        FileFormatError: The file is damaged.
    """
    if not Path(path).is_file():
        return None
    with parsing(path, "truth of a recording"):
        arrays = read_arrays(read_bytes(path, "truth"), MAX_BYTES)
        length, week = _floats(arrays["size"], 1)
        row = PlantRow(*_parts(arrays, ""), length=float(length), week=int(week))
        if _BEHIND + ShapeTables._fields[0] in arrays:
            row = replace(row, behind=PlantRow(*_parts(arrays, _BEHIND), length=row.length, week=row.week))
        if not (row.length > 0 and row.week >= 0):
            raise InvalidValueError(f"expected a positive length and a week from 0 up, got {row.length}, {row.week}")
    return row


def _parts(arrays: Mapping[str, Array], prefix: str) -> tuple[tuple, tuple, tuple]:  # type: ignore[type-arg]
    parts = from_tables(ShapeTables(*(_floats(arrays[prefix + name], 2) for name in ShapeTables._fields)))
    return parts.tomatoes, parts.stems, parts.clutter


def _floats(array: Array, dimensions: int) -> Array:
    if array.dtype != np.float64 or array.ndim != dimensions or not np.isfinite(array).all():
        raise InvalidValueError(f"expected finite float64 numbers, got {array.dtype} of shape {array.shape}")
    return array
