"""Spheres of a known radius on points of skin that nothing explains yet."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from greenhouse_gym.geometry import Array

_FITS, _STAYS = 4, 0.6  # Gauss-Newton steps, and weight of where a middle was, in points
_INLIER, _FEWEST, _PURE = 0.004, 10, 0.7  # metres from a sphere, points on one, and fraction of those within it
_SEEDS = 6  # points from which it starts


def fitted_center(points: Array, center: Array, radius: float) -> Array:
    """Return the middle (3,) of a sphere of a known radius with points (k, 3) on its surface.

    Args:
        points: Points, metres.
        center: Where the middle was; a weak pull to it keeps what a narrow view does not show.
        radius: Metres.
    """
    for _ in range(_FITS):
        offsets = center - points
        lengths = np.maximum(np.linalg.norm(offsets, axis=1), 1e-6)
        rows = offsets / lengths[:, None]
        center = center + np.linalg.solve(rows.T @ rows + _STAYS * np.eye(3), rows.T @ (radius - lengths))
    return np.asarray(center)


def spheres_on(points: Array, camera: Array, radius: float, known: Array) -> list[Array]:
    """Return the middles of spheres that points on skin show, away from known ones, all in metres.

    Args:
        points: (k, 3) points that no known sphere explains.
        camera: (3,) where they were seen from.
        radius: Radius of the spheres.
        known: (n, 3) middles of spheres that are known.
    """
    found: list[Array] = []
    for _ in range(_SEEDS):
        if len(points) < _FEWEST:
            break
        offsets = points - camera
        nearest = int(np.linalg.norm(offsets, axis=1).argmin())
        center = points[nearest] + radius * offsets[nearest] / np.linalg.norm(offsets[nearest])
        for _ in range(2):
            around = np.linalg.norm(points - center, axis=1) < 1.3 * radius
            center = fitted_center(points[around], center, radius) if around.any() else center
        apart = np.linalg.norm(points - center, axis=1)
        within, on = apart < 1.15 * radius, np.abs(apart - radius) < _INLIER
        others = [*known, *found]
        new = not others or cdist(center[None], others).min() > radius
        if new and on.sum() >= max(_FEWEST, _PURE * within.sum()):
            found.append(center)
        within[nearest] = True
        points = points[~within]
    return found
