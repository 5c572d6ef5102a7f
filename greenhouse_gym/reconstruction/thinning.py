"""Which points of a cloud to keep: an even choice of a given size, or those that do not repeat each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

_CUBES = 2**20
"""Most cubes along an axis: three such numbers fit into one of 63 bits."""


def spread_out(points: Array, target: int) -> npt.NDArray[np.int64]:
    """Rows of ``target`` points (within 2 %) of more, spread evenly, in ascending order."""
    local = points - points.min(axis=0)
    extent = float(local.max()) or 1.0
    small, large = extent / _CUBES, 2.0 * extent
    while large > 1.0001 * small:
        size = float(np.sqrt(small * large))
        count = 1 + np.count_nonzero(np.diff(np.sort(_cubes(local, size))))
        if abs(count - target) <= 0.02 * target:
            return _one_per_cube(local, size)
        small, large = (size, large) if count > target else (small, size)
    kept, finer = _one_per_cube(local, large), _one_per_cube(local, small)
    others = np.setdiff1d(finer if len(finer) >= target else np.arange(len(points)), kept)
    missing = target - len(kept)
    return np.sort(np.concatenate([kept, others[np.arange(missing) * len(others) // missing]]))


def _cubes(local: Array, size: float) -> npt.NDArray[np.int64]:
    """The number (n,) of the cube each point lies in; points (n, 3) have no negative coordinates."""
    x, y, z = (local.T / size).astype(np.int64)
    return np.asarray(x << 42 | y << 21 | z)


def _one_per_cube(local: Array, size: float) -> npt.NDArray[np.int64]:
    """Rows of the points nearest to the centers of the occupied cubes, in ascending order."""
    order = np.argsort(((local / size % 1.0 - 0.5) ** 2).sum(axis=1), kind="stable")
    return np.sort(order[first_of_each(_cubes(local[order], size)[:, None])])


def first_of_each(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Where each different row of ``values`` (n, k) appears first, in ascending order (as `numpy.unique`, but fast)."""
    order = np.lexsort(values.T)
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(values[order], axis=0) != 0).any(axis=1)
    return np.sort(order[first])


def apart(points: Array) -> tuple[npt.NDArray[np.int64], float]:
    """Rows of points none of which (nearly) repeats another, and the spacing of those points, metres."""
    rows = first_of_each(points)
    spacing = _spacing(points[rows])
    cubes = np.floor((points[rows] - points.min(axis=0)) / (0.2 * spacing))
    rows = rows[first_of_each(cubes)]
    rows = np.delete(rows, cKDTree(points[rows]).query_pairs(0.1 * spacing, output_type="ndarray")[:, 1])
    return rows, _spacing(points[rows])


def _spacing(points: Array) -> float:
    """The usual distance between neighbors, metres, even where a few points nearly repeat each other.

    In clouds thinned to one point per cube the sixth neighbor lies 1.7 times as far as the first.
    """
    if len(points) < 4:
        raise InvalidValueError(f"a mesh needs at least 4 points, got {len(points)} different ones")
    some = points[:: len(points) // 20_000 + 1]
    return float(np.median(cKDTree(points).query(some, k=[min(7, len(points))])[0])) / 1.7
