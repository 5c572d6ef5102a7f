"""Kernels of grids of equal cells: the cells of points, and those that rays from a camera pass."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry.arrays import Array


@inlined
def cell_of(x, y, z, low, shape, cell):
    """Return the flat index of the cell of a point in a grid of shape (x, y, z); -1 outside of it."""
    i, j, k = (x - low[0]) / cell, (y - low[1]) / cell, (z - low[2]) / cell
    if 0.0 <= i < shape[0] and 0.0 <= j < shape[1] and 0.0 <= k < shape[2]:
        return (int(i) * shape[1] + int(j)) * shape[2] + int(k)
    return -1


@kernel("void(f8[:, ::1], f8[::1], i8[::1], f8, i8[::1])", writes=("cells",))
def cells_of_points(
    points: Array, low: Array, shape: npt.NDArray[np.int64], cell: float, cells: npt.NDArray[np.int64]
) -> None:
    """Write the flat indices (n,) of the cells of points (n, 3), metres; -1 outside of the grid.

    Args:
        points: (n, 3) metres.
        low: (3,) lower corner of the grid, metres.
        shape: (3,) its number of cells.
        cell: Side of a cell, metres.
        cells: (n,) result.
    """
    for i in range(len(points)):
        cells[i] = cell_of(points[i, 0], points[i, 1], points[i, 2], low, shape, cell)


@kernel("void(f8[::1], f8[:, ::1], f8[::1], f8[::1], i8[::1], f8, b1[::1])", writes=("passed",))
def mark_passed(
    origin: Array,
    rays: Array,
    lengths: Array,
    low: Array,
    shape: npt.NDArray[np.int64],
    cell: float,
    passed: npt.NDArray[np.bool_],
) -> None:
    """Mark the cells that rays from a point pass, sampled once per side of a cell.

    Args:
        origin: (3,) metres.
        rays: (m, 3) directions.
        lengths: (m,) length of each ray, as a multiple of its direction.
        low: (3,) lower corner of the grid, metres.
        shape: (3,) its number of cells.
        cell: Side of a cell, metres.
        passed: (size,) whether each cell was passed.
    """
    for i in range(len(rays)):
        along = 0.5
        while along * cell < lengths[i]:
            depth = along * cell
            found = cell_of(
                origin[0] + depth * rays[i, 0], origin[1] + depth * rays[i, 1], origin[2] + depth * rays[i, 2],
                low, shape, cell,
            )  # fmt: skip
            if found >= 0:
                passed[found] = True
            along += 1.0
