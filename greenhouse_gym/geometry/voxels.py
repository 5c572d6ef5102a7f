"""Cells of points in grids of equal cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def cells_of(
    points: npt.ArrayLike, low: npt.ArrayLike, shape: Sequence[int] | npt.NDArray[np.int64], cell: float
) -> npt.NDArray[np.int64]:
    """Return the flat indices (n,) of the cells of points (n, 3), metres; -1 outside of the grid.

    Args:
        points: (n, 3) metres.
        low: (3,) lower corner of the grid, metres.
        shape: Number of cells along x, y and z.
        cell: Side of a cell, metres.
    """
    from greenhouse_gym.geometry.voxel_kernels import cells_of_points  # loads numba

    p = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    cells = np.empty(len(p), dtype=np.int64)
    corner, counts = np.ascontiguousarray(low, dtype=np.float64), np.asarray(shape, dtype=np.int64)
    cells_of_points(p, corner, counts, float(cell), cells)
    return cells


def passed_cells(
    origin: npt.ArrayLike,
    rays: npt.ArrayLike,
    lengths: npt.ArrayLike,
    low: npt.ArrayLike,
    shape: Sequence[int] | npt.NDArray[np.int64],
    cell: float,
) -> npt.NDArray[np.bool_]:
    """Return which cells, in the order of their flat indices, are passed by rays that are sampled once per side.

    Args:
        origin: (3,) where the rays begin, metres.
        rays: (m, 3) their directions.
        lengths: (m,) their lengths, as multiples of their directions.
        low: (3,) lower corner of the grid, metres.
        shape: Number of cells along x, y and z.
        cell: Side of a cell, metres.
    """
    from greenhouse_gym.geometry.voxel_kernels import mark_passed  # loads numba

    o, r, n, corner = (np.ascontiguousarray(each, dtype=np.float64) for each in (origin, rays, lengths, low))
    passed = np.zeros(int(np.prod(shape)), dtype=np.bool_)
    mark_passed(o, r, n, corner, np.asarray(shape, dtype=np.int64), float(cell), passed)
    return passed
