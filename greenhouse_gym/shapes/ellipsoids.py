"""Fruit that is longer or flatter than a ball: spheroids fitted to what the spheres have found.

From one side hardly anything tells how deep a fruit is. But the fruits of a row are of one cultivar, and some show
their length and some their end: how long they are for their width is what explains all together best. Held fast, it
lets each fruit's center, size and direction be refined.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import SphereFit, even_directions, shell_of
from greenhouse_gym.shapes.surfaces import SurfaceCloud

_FRAMES = [frame_along(axis) for axis in even_directions(26) if axis[2] > 0]  # whose axes are tried first
_MOST_POINTS = 120  # a fit looks at
_NOISE = 0.0015  # metres: points farther off count less
_ALIGNED = 0.5  # least cosine between normals and the sphere's
_WELL_SEEN = 0.22  # share of a sphere that must show to tell how long a fruit is
_FEWEST_SEEN = 6  # fruits that tell it
_STRETCHES = np.linspace(-0.4, 0.56, 9)  # log length / width that are tried
_LEAST = 0.06  # of it below which fruit is round
_SAVED = 0.06  # share of the cost of round fruit that other fruit must save
_TRIED = 12  # fruits that are asked
_LEAN = 1.5  # standard deviation of an axis from the vertical, a tangent: fruit hangs more upright than not
_SIZE = 0.15  # standard deviation of a width from the sphere's, a logarithm


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
    asked = seen[:: max(1, len(seen) // _TRIED)]
    costs = np.array([sum(_fit(fits[k], skins[k], stretch)[1] for k in asked) for stretch in _STRETCHES])
    best = int(np.argmin(costs))
    stretch = float(_STRETCHES[best])
    if 0 < best < len(costs) - 1:  # the vertex of the parabola through the three lowest
        below, here, above = costs[best - 1 : best + 2]
        stretch += float(_STRETCHES[1] - _STRETCHES[0]) * float((below - above) / (2 * (below - 2 * here + above)))
    round_cost = float(np.interp(0.0, _STRETCHES, costs))
    if abs(stretch) < _LEAST or costs[best] > (1 - _SAVED) * round_cost:
        return None
    return [_fit(fit, skin, stretch)[0] for fit, skin in zip(fits, skins, strict=True)]


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


def _fit(fit: SphereFit, skin: Array, stretch: float) -> tuple[Spheroid, float]:
    """The spheroid of one stretch with least robust distances from points (k, 3), and their cost."""
    start = Spheroid(fit.center, fit.radius * np.exp(-stretch / 3), stretch, np.array([0.0, 0.0, 1.0]))
    if len(skin) < 8:
        return start, 0.0
    weight = 0.3 * np.sqrt(len(skin))
    fits = []
    for frame in _FRAMES:

        def spheroid(x: Array, frame: Array = frame) -> Spheroid:
            axis = frame @ [x[4], x[5], 1.0]
            return Spheroid(
                fit.center + 0.01 * x[:3], start.width * float(np.exp(x[3])), stretch, axis / np.linalg.norm(axis)
            )

        def cost(x: Array, spheroid: Callable[[Array], Spheroid] = spheroid) -> Array:
            one = spheroid(x)
            off = _distances(one, skin) / _NOISE
            off /= np.sqrt(1 + off**2 / 8)  # what is far off counts little more than what is not near
            lean = np.hypot(*one.axis[:2]) / max(abs(one.axis[2]), 0.2)
            return np.append(off, weight * np.array([lean / _LEAN, x[3] / _SIZE]))

        fits.append((float((cost(np.zeros(6)) ** 2).sum()), spheroid, cost))
    _, spheroid, cost = min(fits, key=lambda f: f[0])
    found = least_squares(cost, np.zeros(6), max_nfev=15)
    return spheroid(found.x), 2 * float(found.cost)


def _distances(spheroid: Spheroid, points: Array) -> Array:
    """Signed distances (n,) of points (n, 3) from a spheroid, to first order."""
    local = points - spheroid.center
    along = local @ spheroid.axis
    across = np.sqrt(np.maximum((local * local).sum(axis=1) - along**2, 1e-12))
    long = spheroid.width * np.exp(spheroid.stretch)
    level = np.sqrt((across / spheroid.width) ** 2 + (along / long) ** 2)
    slope = np.sqrt((across / spheroid.width**2) ** 2 + (along / long**2) ** 2) / np.maximum(level, 1e-6)
    return np.asarray((level - 1) / np.maximum(slope, 1e-6))
