"""Voxels around an arm in the frame of its base, and the cells that a camera looks through."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.voxels import cells_of, passed_cells

Cells = npt.NDArray[np.int64]


@dataclass(frozen=True)
class VoxelBox:
    """Box of equal cells in the frame of an arm's base.

    Attributes:
        low: Lower corner, metres.
        shape: Number of cells along x, y and z.
        cell: Side of a cell, metres.
    """

    low: tuple[float, float, float]
    shape: tuple[int, int, int]
    cell: float

    @property
    def size(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))

    @cached_property
    def centers(self) -> Array:
        """(size, 3) centers of the cells in the order of their indices, metres."""
        return np.asarray((np.indices(self.shape).reshape(3, -1).T + 0.5) * self.cell + self.low, dtype=np.float64)

    def indices(self, points: Array) -> Cells:
        """Return the flat indices (n,) of the cells of points (n, 3), metres; -1 outside of the box."""
        return cells_of(points, self.low, self.shape, self.cell)

    def looked_through(self, origin: Array, rays: Array, free: Array) -> npt.NDArray[np.bool_]:
        """Return which cells (size,) a camera looks through.

        Args:
            origin: (3,) position of the camera, metres.
            rays: (m, 3) directions of its pixels, of length 1 along the view.
            free: (m,) depth along the view up to which space is free, metres.
        """
        return passed_cells(origin, rays, free, self.low, self.shape, self.cell)
