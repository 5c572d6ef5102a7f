"""A second look at each truss for fruit that hides behind the others, by the size that these have in common.

Of such a fruit a narrow piece shows, whose normals its neighbors bend, so that neither its size nor the direction of
its center can be told from it. But the fruits of one truss are much of one size and one color. So whatever the spheres
found first leave unexplained near a truss, in its color, votes for all centers one radius behind it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import IN_SIZE, SphereFit, crowded, even_directions, fit_spheres, peaks

_CELL = 1 / 3  # side of the vote's cells, in radii
_FEWEST = 7  # points that vote for one place
_TONE = 0.15  # redness by which a fruit may differ from those of its truss
_OVERLAP = 0.15  # radii by which a sphere may reach into its neighbors


def look_again(
    points: Array,
    normals: Array,
    tones: Array,
    fits: list[SphereFit],
    trusses: npt.NDArray[np.int32],
    settings: ShapeSettings,
) -> list[SphereFit]:
    """Fit spheres to what others leave unexplained.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors out of the surfaces, roughly.
        tones: (n,) redness.
        fits: The spheres found so far.
        trusses: Truss number (k,) of each.
        settings: All settings.

    Returns:
        Spheres of the sizes of their trusses.
    """
    explained = np.zeros(len(points), dtype=bool)
    tree = cKDTree(points)
    for fit in fits:
        explained[tree.query_ball_point(fit.center, fit.radius + settings.shell)] = True
    left = np.flatnonzero(~explained)
    if not len(left):
        return []
    tone = np.array([np.median(tones[fit.points]) for fit in fits])
    points, normals, tones = points[left], normals[left], tones[left]
    tree = cKDTree(points)
    candidates = [np.zeros((0, 4))]
    for truss in np.unique(trusses):
        own = np.flatnonzero(trusses == truss)
        centers = np.array([fits[i].center for i in own])
        radius = float(np.median([fits[i].radius for i in own]))
        balls = tree.query_ball_point(centers, 3 * radius + settings.truss_gap)
        near = np.unique(np.concatenate([np.array(ball, dtype=np.int64) for ball in balls]))
        alike = (tones[near] > tone[own].min() - _TONE) & (tones[near] < tone[own].max() + _TONE)
        candidates.append(_vote(points[near[alike]], normals[near[alike]], centers, radius, settings))
    found = fit_spheres(points, normals, np.concatenate(candidates), settings, IN_SIZE)
    return [replace(fit, points=left[fit.points]) for fit in found]


def _vote(points: Array, normals: Array, centers: Array, radius: float, settings: ShapeSettings) -> Array:
    """Candidates (k, 4) beside fruits at ``centers`` of which points (n, 3) may show a piece."""
    directions = even_directions(round(4 * np.pi / _CELL**2))
    point, direction = np.nonzero(normals @ directions.T > 0)
    votes = points[point] - radius * directions[direction]
    gap = cKDTree(centers).query(votes)[0] - 2 * radius
    votes = votes[(gap > -_OVERLAP * radius) & (gap < settings.truss_gap)]
    if not len(votes):
        return np.zeros((0, 4))
    cell = _CELL * radius
    per_point = 9 * _CELL**2 * len(directions) / (4 * np.pi)  # of a point's votes, those that fall near one place
    found, count = crowded(votes / cell, _FEWEST * per_point)
    found = found[peaks(found, count, 0.6 / _CELL)] * cell
    return np.column_stack([found, np.full(len(found), radius)])
