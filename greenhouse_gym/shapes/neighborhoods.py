"""Means and moments over the neighborhoods of points."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array


class Neighborhoods:
    """Neighborhoods of points (n, 3): all points within ``reach`` metres of each, itself included.

    Attributes:
        count: (n,) number of points in each neighborhood.
    """

    def __init__(self, points: Array, reach: float):
        pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
        self._near = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(points),) * 2).tocsr()
        self.count: Array = np.asarray(self._near.sum(axis=0) + self._near.sum(axis=1) + 1.0)

    def mean(self, values: Array) -> Array:
        """Return the means (n, k) of values (n, k) over the neighborhoods."""
        return np.asarray((self._near @ values + self._near.T @ values + values) / self.count[:, None])

    def moments(self, a: Array, b: Array) -> Array:
        """Return the mean outer products (n, 3, 3) of vectors (n, 3) and (n, 3)."""
        return self.mean((a[:, :, None] * b[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)

    def covariances(self, a: Array, b: Array) -> Array:
        """Return the covariances (n, 3, 3) of vectors (n, 3) and (n, 3)."""
        mean_a, mean_b = self.mean(a), self.mean(b)
        return np.asarray(self.moments(a, b) - mean_a[:, :, None] * mean_b[:, None, :])
