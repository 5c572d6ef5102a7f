"""Voxels around an arm in the frame of its base, and the cells that a camera looks through."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array

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
        cells = np.floor((points - np.asarray(self.low)) / self.cell)
        inside = ((cells >= 0) & (cells < self.shape)).all(axis=1)
        x, y, z = np.where(inside[:, None], cells, 0).astype(np.int64).T
        return np.where(inside, (x * self.shape[1] + y) * self.shape[2] + z, -1)

    def looked_through(self, origin: Array, rays: Array, free: Array) -> Cells:
        """Return the flat indices, with repetitions, of the cells that a camera looks through.

        Args:
            origin: (3,) position of the camera, metres.
            rays: (m, 3) directions of its pixels, of length 1 along the view.
            free: (m,) depth along the view up to which space is free, metres.
        """
        depths = np.arange(0.5, free.max(initial=0.0) / self.cell) * self.cell
        ray, step = np.nonzero(depths < free[:, None])
        found = self.indices(origin + depths[step, None] * rays[ray])
        return np.asarray(found[found >= 0])
