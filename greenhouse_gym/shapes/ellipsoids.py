"""Fruit that is longer or flatter than a ball: spheroids fitted to what the spheres have found.

From one side hardly anything tells how deep a fruit is. But the fruits of a row are of one cultivar, and some show
their length and some their end: how long they are for their width is what explains all together best. Held fast, it
lets each fruit's center, size and direction be refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import SphereFit, even_directions, shell_of
from greenhouse_gym.shapes.surfaces import SurfaceCloud

_FRAMES = [frame_along(axis) for axis in even_directions(26) if axis[2] > 0]  # frames whose axes are tried first
_MOST_POINTS = 120  # most points that a fit looks at
_FEWEST_POINTS = 8  # with fewer it stays a ball
_NOISE = 0.0015  # metres: points farther off count less
_ALIGNED = 0.5  # least cosine between normals and the sphere's
_WELL_SEEN = 0.22  # share of a sphere that must show to tell how long a fruit is
_FEWEST_SEEN = 6  # fruits that tell it
_STRETCHES = np.linspace(-0.4, 0.56, 9)  # log length / width that are tried
_LEAST = 0.06  # log length / width below which fruit is round
_SAVED = 0.06  # share of the cost of round fruit that other fruit must save
_TRIED = 12  # fruits that are asked
_LEAN = 1.5  # standard deviation of an axis from the vertical, a tangent: fruit hangs more upright than not
_LOOKS = 3  # at the skin, each by what the one before found
_ROUNDS = 12
_STEP = 1e-5  # by which the parameters are changed to tell slopes
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
    tree = cKDTree(cloud.points)
    balls = [Spheroid(fit.center, fit.radius, 0.0, np.array([0.0, 0.0, 1.0])) for fit in fits]
    found: list[Spheroid] | None = None
    for _ in range(_LOOKS):  # the ends of long fruit are too far from balls to be taken for their skin at first
        skins = _skins(found or balls, cloud, tree, settings)
        seen = [k for k, fit in enumerate(fits) if fit.coverage > _WELL_SEEN and len(skins[k]) >= 40]
        stretch = _common_stretch(found or balls, skins, seen) if len(seen) >= _FEWEST_SEEN else None
        if stretch is None:
            break
        found = _fit(found or balls, skins, np.full(len(fits), stretch))[0]
    return found


def _common_stretch(fits: Sequence[Spheroid], skins: Sequence[Array], seen: Sequence[int]) -> float | None:
    """The log of the length per width that explains best what shows of some fruits; None if they are round."""
    asked = seen[:: max(1, len(seen) // _TRIED)]
    tried = np.repeat(_STRETCHES, len(asked))
    each = _fit([fits[k] for k in asked] * len(_STRETCHES), [skins[k] for k in asked] * len(_STRETCHES), tried)[1]
    costs = each.reshape(len(_STRETCHES), -1).sum(axis=1)
    best = int(np.argmin(costs))
    stretch = float(_STRETCHES[best])
    if 0 < best < len(costs) - 1:  # the vertex of the parabola through the three lowest
        below, here, above = costs[best - 1 : best + 2]
        stretch += float(_STRETCHES[1] - _STRETCHES[0]) * float((below - above) / (2 * (below - 2 * here + above)))
    round_cost = float(np.interp(0.0, _STRETCHES, costs))
    return None if abs(stretch) < _LEAST or costs[best] > (1 - _SAVED) * round_cost else stretch


def _skins(fits: Sequence[Spheroid], cloud: SurfaceCloud, tree: cKDTree, settings: ShapeSettings) -> list[Array]:
    """Points (k, 3) of a cloud, and of its tree, that each spheroid is the nearest to, and that lie about on it."""
    longest = [1.3 * float(fit.semi_axes.max()) for fit in fits]
    near = [
        np.array(tree.query_ball_point(fit.center, r), dtype=np.int64) for fit, r in zip(fits, longest, strict=True)
    ]
    nearest = np.full(len(cloud), np.inf)
    residuals = []
    for fit, rows in zip(fits, near, strict=True):
        away = cloud.points[rows] - fit.center
        axis, width, stretch = fit.axis[None], np.array([[fit.width]]), np.array([fit.stretch])
        residuals.append(_distances(away[None], axis, width, stretch)[0])
        nearest[rows] = np.minimum(nearest[rows], np.abs(residuals[-1]))
    skins = []
    for fit, rows, residual in zip(fits, near, residuals, strict=True):
        away = cloud.points[rows] - fit.center
        unit = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        own = np.abs(residual) < max(shell_of(fit.radius, settings), 0.2 * fit.radius)
        own &= (np.abs(residual) <= nearest[rows]) & ((unit * cloud.normals[rows]).sum(axis=1) > _ALIGNED)
        kept = rows[own]
        skins.append(cloud.points[kept[:: max(1, len(kept) // _MOST_POINTS)]])
    return skins


class _Seen(NamedTuple):
    """Spheres (k,) to be refined as spheroids, and the skin of each.

    Attributes:
        centers: (k, 3) metres.
        widths: (k,) at first, metres.
        stretches: (k,) that are held.
        points: (k, n, 3) metres, filled up where a skin has fewer.
        real: (k, n) 1 for points, 0 for what only fills up.
        frames: (k, 3, 3) whose last column is the axis at first.
    """

    centers: Array
    widths: Array
    stretches: Array
    points: Array
    real: Array
    frames: Array

    def axes(self, x: Array) -> Array:
        """(k, 3) along the spheroids at parameters (k, 6): moved by centimetres, log of the width, two tilts."""
        axes = (self.frames @ np.column_stack([x[:, 4:], np.ones(len(x))])[:, :, None])[:, :, 0]
        return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))

    def residuals(self, x: Array) -> Array:
        """(k, n + 2): robust distances of the points, then how far it leans and has grown, at parameters (k, 6)."""
        axes = self.axes(x)
        width = (self.widths * np.exp(x[:, 3]))[:, None]
        off = _distances(self.points - (self.centers + 0.01 * x[:, :3])[:, None], axes, width, self.stretches) / _NOISE
        off *= self.real / np.sqrt(1 + off**2 / 8)  # what is far off counts little more than what is not near
        lean = np.hypot(axes[:, 0], axes[:, 1]) / np.maximum(np.abs(axes[:, 2]), 0.2)
        weight = 0.3 * np.sqrt(self.real.sum(axis=1))
        return np.column_stack([off, weight * lean / _LEAN, weight * x[:, 3] / _SIZE])


def _fit(fits: Sequence[Spheroid], skins: Sequence[Array], stretches: Array) -> tuple[list[Spheroid], Array]:
    """The spheroids of given stretches (k,) with least robust distances from their skins, and their costs (k,).

    All are refined at once by the method of Levenberg and Marquardt.
    """
    many = max((len(skin) for skin in skins), default=0)
    points, real = np.zeros((len(fits), max(many, 1), 3)), np.zeros((len(fits), max(many, 1)))
    for k, skin in enumerate(skins):
        if len(skin) >= _FEWEST_POINTS:
            points[k, : len(skin)], real[k, : len(skin)] = skin, 1.0
    centers, radii = np.array([f.center for f in fits]).reshape(-1, 3), np.array([f.radius for f in fits])
    points[real == 0] = np.repeat(centers, (real == 0).sum(axis=1), axis=0)
    seen = _Seen(
        centers, radii * np.exp(-stretches / 3), stretches, points, real, np.tile(_FRAMES[0], (len(fits), 1, 1))
    )
    x = np.zeros((len(fits), 6))
    tried = [
        (seen._replace(frames=np.tile(frame, (len(fits), 1, 1))).residuals(x) ** 2).sum(axis=1) for frame in _FRAMES
    ]
    seen = seen._replace(frames=np.array(_FRAMES)[np.argmin(tried, axis=0)])
    residuals = seen.residuals(x)
    damping = np.full(len(fits), 1e-3)
    for _ in range(_ROUNDS):
        slopes = np.stack([(seen.residuals(x + step) - residuals) / _STEP for step in _STEP * np.eye(6)], axis=2)
        normal = slopes.transpose(0, 2, 1) @ slopes
        held = damping[:, None, None] * normal * np.eye(6) + 1e-6 * np.eye(6)
        moved = x - np.linalg.solve(normal + held, slopes.transpose(0, 2, 1) @ residuals[:, :, None])[:, :, 0]
        after = seen.residuals(moved)
        better = (after**2).sum(axis=1) < (residuals**2).sum(axis=1)
        x, residuals = np.where(better[:, None], moved, x), np.where(better[:, None], after, residuals)
        damping = np.where(better, damping / 5, 5 * damping)
    widths = seen.widths * np.exp(x[:, 3])
    spheroids = map(Spheroid, centers + 0.01 * x[:, :3], widths.tolist(), stretches.tolist(), seen.axes(x))
    return list(spheroids), np.asarray((residuals**2).sum(axis=1))


def _distances(points: Array, axes: Array, widths: Array, stretches: Array) -> Array:
    """Signed distances (k, n) of points (k, n, 3) from spheroids around the origin, to first order.

    Args:
        points: (k, n, 3) metres.
        axes: (k, 3) unit vectors.
        widths: (k, 1) radii across the axes, metres.
        stretches: (k,) logs of the radii along the axes over the widths.
    """
    along = (points @ axes[:, :, None])[:, :, 0]
    across = np.sqrt(np.maximum((points * points).sum(axis=2) - along**2, 1e-12))
    long = widths * np.exp(stretches)[:, None]
    level = np.sqrt((across / widths) ** 2 + (along / long) ** 2)
    slope = np.sqrt((across / widths**2) ** 2 + (along / long**2) ** 2) / np.maximum(level, 1e-6)
    return np.asarray((level - 1) / np.maximum(slope, 1e-6))
