"""A second pass around each truss for fruit hidden behind its neighbors, using their common size.

Only a narrow piece of such a fruit shows, and its normals are distorted by its neighbors, so neither its size nor the
direction of its center can be estimated from it. But the fruits of one truss have similar size and hue. So every point
near a truss that is not yet explained, and has its hue, votes for all centers at one radius behind it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.evidence import SHELL
from greenhouse_gym.shapes.fruit.spheres import (
    SIZE_KNOWN,
    Bounds,
    SphereFit,
    dense_cells,
    even_directions,
    fit_spheres,
    local_maxima,
)
from greenhouse_gym.shapes.fruit.trusses import NEIGHBOR_GAP
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud

_CELL = 1 / 3  # side of the vote's cells, in radii
_MIN_VOTERS = 7  # points that vote for one center
_HUE_TOLERANCE = 0.15  # redness by which a fruit may differ from those of its truss
_OVERLAP = 0.15  # radii by which a sphere may reach into its neighbors


def fit_hidden(
    skin: SurfaceCloud, found: list[SphereFit], trusses: npt.NDArray[np.int32], radii: Bounds
) -> list[SphereFit]:
    """Fit spheres of the sizes of their trusses to points that the fruit found so far does not explain.

    Args:
        skin: The points that may be fruit.
        found: The fruit found so far, among ``skin``.
        trusses: (k,) truss number of each fruit.
        radii: Smallest and largest radius of tomatoes, metres.

    Returns:
        Spheres among ``skin``.
    """
    explained = np.zeros(len(skin), dtype=bool)
    tree = cKDTree(skin.points)
    for fit in found:
        explained[tree.query_ball_point(fit.center, fit.radius + SHELL)] = True
    left = np.flatnonzero(~explained)
    if not len(left):
        return []
    hue = np.array([np.median(skin.hues[fit.points]) for fit in found])
    points, normals, hues = skin.points[left], skin.normals[left], skin.hues[left]
    tree = cKDTree(points)
    candidates = [np.zeros((0, 4))]
    for truss in np.unique(trusses):
        own = np.flatnonzero(trusses == truss)
        centers = np.array([found[i].center for i in own])
        radius = float(np.median([found[i].radius for i in own]))
        balls = tree.query_ball_point(centers, 3 * radius + NEIGHBOR_GAP)
        near = np.unique(np.concatenate([np.array(ball, dtype=np.int64) for ball in balls]))
        alike = (hues[near] > hue[own].min() - _HUE_TOLERANCE) & (hues[near] < hue[own].max() + _HUE_TOLERANCE)
        candidates.append(_vote(points[near[alike]], normals[near[alike]], centers, radius))
    fits = fit_spheres(points, normals, np.concatenate(candidates), radii, SIZE_KNOWN)
    return [replace(fit, points=left[fit.points]) for fit in fits]


def _vote(points: Array, normals: Array, centers: Array, radius: float) -> Array:
    """Return candidates (k, 4) next to the fruits at ``centers`` that points (n, 3) vote for."""
    directions = even_directions(round(4 * np.pi / _CELL**2))
    point, direction = np.nonzero(normals @ directions.T > 0)
    votes = points[point] - radius * directions[direction]
    gap = cKDTree(centers).query(votes)[0] - 2 * radius
    votes = votes[(gap > -_OVERLAP * radius) & (gap < NEIGHBOR_GAP)]
    if not len(votes):
        return np.zeros((0, 4))
    cell = _CELL * radius
    per_point = 9 * _CELL**2 * len(directions) / (4 * np.pi)  # number of a point's votes near one center
    cells, count = dense_cells(votes / cell, _MIN_VOTERS * per_point)
    cells = cells[local_maxima(cells, count, 0.6 / _CELL)] * cell
    return np.column_stack([cells, np.full(len(cells), radius)])
