"""Fruit that is longer or flatter than a ball: spheroids fitted to what the spheres have found.

From one side hardly anything tells how deep a fruit is. But the fruits of a row are of one cultivar, and as many of them
lie this way as that: how long they are for their width is estimated from those that are seen well, and then held fast
while each fruit's center, size and direction are refined. Fruit hangs more upright than not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import SphereFit, shell_of
from greenhouse_gym.shapes.surfaces import SurfaceCloud

_MOST_POINTS = 250  # a fit looks at
_NOISE = 0.0015  # metres: points farther off count less
_ALIGNED = 0.5  # least cosine between normals and the sphere's
_WELL_SEEN = 0.22  # share of a sphere that must show to tell how long a fruit is
_FEWEST_SEEN = 6  # fruits that tell it
_FREE, _HELD = 0.5, 0.02  # standard deviations of log length / width before and after the row has told it
_TILT = 0.6  # standard deviation of an axis from the vertical, a tangent
_PRIOR = 0.0015  # metres: what one standard deviation weighs, times the root of the number of points
_LEAST = 0.04  # |log length / width| below which fruit is round
_MOST = 0.7


class Spheroid(NamedTuple):
    """A ball stretched along an axis.

    Attributes:
        center: (3,) metres.
        width: Radius across the axis, metres.
        stretch: log of the radius along the axis over ``width``.
        axis: (3,) unit vector.
    """

    center: Array
    width: float
    stretch: float
    axis: Array

    @property
    def semi_axes(self) -> Array:
        """(3,) metres, the last along the axis."""
        return self.width * np.array([1.0, 1.0, np.exp(self.stretch)])

    @property
    def radius(self) -> float:
        """Radius of the ball of the same volume, metres."""
        return float(self.width * np.exp(self.stretch / 3))

    @property
    def rotation(self) -> Array:
        """(3, 3), the last column along the axis."""
        return frame_along(self.axis)


def stretched(fits: Sequence[SphereFit], cloud: SurfaceCloud, settings: ShapeSettings) -> list[Spheroid] | None:
    """The spheres as spheroids of one length per width, or None where the row's fruit is round."""
    skins = _skins(fits, cloud, settings)
    seen = [k for k, fit in enumerate(fits) if fit.coverage > _WELL_SEEN and len(skins[k]) >= 40]
    if len(seen) < _FEWEST_SEEN:
        return None
    free = [_fit(fits[k], skins[k], 0.0, _FREE) for k in seen]
    usual = float(np.clip(np.median([one.stretch for one in free]), -_MOST, _MOST))
    if abs(usual) < _LEAST:
        return None
    return [_fit(fit, skin, usual, _HELD) for fit, skin in zip(fits, skins, strict=True)]


def _skins(fits: Sequence[SphereFit], cloud: SurfaceCloud, settings: ShapeSettings) -> list[Array]:
    """Points (k, 3) that each sphere is the nearest to, and that lie about on it."""
    tree = cKDTree(cloud.points)
    near = [np.array(tree.query_ball_point(fit.center, 1.3 * fit.radius), dtype=np.int64) for fit in fits]
    nearest = np.full(len(cloud), np.inf)
    residuals = []
    for fit, rows in zip(fits, near, strict=True):
        residuals.append(np.linalg.norm(cloud.points[rows] - fit.center, axis=1) - fit.radius)
        nearest[rows] = np.minimum(nearest[rows], np.abs(residuals[-1]))
    skins = []
    for fit, rows, residual in zip(fits, near, residuals, strict=True):
        unit = (cloud.points[rows] - fit.center) / np.maximum(residual + fit.radius, 1e-9)[:, None]
        own = np.abs(residual) < max(shell_of(fit.radius, settings), 0.2 * fit.radius)
        own &= (np.abs(residual) <= nearest[rows]) & ((unit * cloud.normals[rows]).sum(axis=1) > _ALIGNED)
        kept = rows[own]
        skins.append(cloud.points[kept[:: max(1, len(kept) // _MOST_POINTS)]])
    return skins


def _fit(fit: SphereFit, skin: Array, stretch: float, deviation: float) -> Spheroid:
    """The spheroid with least robust distances from points (k, 3), its stretch held near one by so much."""
    if len(skin) < 8:
        return Spheroid(fit.center, fit.radius * np.exp(-stretch / 3), stretch, np.array([0.0, 0.0, 1.0]))
    away = skin - fit.center
    weight = _PRIOR * np.sqrt(len(skin))

    def spheroid(x: Array) -> Spheroid:
        axis = np.array([x[5], x[6], 1.0])
        return Spheroid(
            fit.center + 0.01 * x[:3], fit.radius * np.exp(x[3] - x[4] / 3), float(x[4]), axis / np.linalg.norm(axis)
        )

    def cost(x: Array) -> Array:
        one = spheroid(x)
        local = away - 0.01 * x[:3]
        along = local @ one.axis
        across = np.sqrt(np.maximum((local * local).sum(axis=1) - along**2, 1e-12))
        long = one.width * np.exp(one.stretch)
        level = np.sqrt((across / one.width) ** 2 + (along / long) ** 2)
        slope = np.sqrt((across / one.width**2) ** 2 + (along / long**2) ** 2) / np.maximum(level, 1e-6)
        off = (level - 1) / np.maximum(slope, 1e-6) / _NOISE
        off = off / np.sqrt(1 + off**2 / 8)  # what is far off counts as much as what is not near
        prior = [(x[4] - stretch) / deviation, x[5] / _TILT, x[6] / _TILT, x[3] / 0.3]
        return np.concatenate([off * _NOISE, 0.3 * weight * np.array(prior)]) / _NOISE

    starts = [np.array([0.0, 0.0, 0.0, 0.0, stretch, *tilt]) for tilt in ((0.0, 0.0), (0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7))]
    best = min(starts, key=lambda x: float((cost(x) ** 2).sum()))
    return spheroid(least_squares(cost, best, max_nfev=25).x)
