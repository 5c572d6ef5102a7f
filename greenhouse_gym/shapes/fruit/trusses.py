"""Grouping of fruits into trusses by the gaps between their skins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from greenhouse_gym.geometry import Sphere
from greenhouse_gym.shapes.fruit.spheroids import Spheroid

NEIGHBOR_GAP = 0.035
"""Largest gap in metres between the skins of neighbors on one truss."""


def group_neighbors(fruits: Sequence[Sphere], gap: float = NEIGHBOR_GAP) -> npt.NDArray[np.int32]:
    """Return the group number (n,) of each fruit; fruits with at most ``gap`` metres between skins share a group."""
    return _group(fruits, gap, "single")


def group_trusses(fruits: Sequence[Sphere | Spheroid], spread: float) -> npt.NDArray[np.int32]:
    """Return the truss number (n,) of each fruit, counted along the row.

    The two groups with the smallest mean gap over all pairs of their fruits are merged, as long as that gap is at most
    ``spread`` metres (average linkage; Sokal and Michener, 1958). So a fruit between two trusses does not join them,
    and hidden fruit does not split a truss.
    """
    return _group(fruits, spread, "average")


def _group(fruits: Sequence[Sphere | Spheroid], reach: float, method: str) -> npt.NDArray[np.int32]:
    """Return the group number (n,) of each fruit by scipy's linkage of skin gaps, in order of appearance."""
    if len(fruits) < 2:
        return np.zeros(len(fruits), dtype=np.int32)
    centers, radii = np.array([f.center for f in fruits]), np.array([f.radius for f in fruits])
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=-1) - radii[:, None] - radii[None]
    np.fill_diagonal(gaps, 0.0)
    groups = fcluster(linkage(squareform(np.maximum(gaps, 0.0), checks=False), method), reach, "distance")
    _, first, group = np.unique(groups, return_index=True, return_inverse=True)
    return np.asarray(first.argsort().argsort()[group], dtype=np.int32)
