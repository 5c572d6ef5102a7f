"""Spheroids for fruit that is longer or flatter than a sphere, fitted to the skin around the spheres found.

The depth of a fruit is hardly visible from one side. But the fruits of a row are of one cultivar, and some show their
length and others their end, so their common ratio of length to width is the one that explains all of them best.
With that ratio fixed, each fruit's center, size and direction are refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.shapes.fruit.spheres import SphereFit, even_directions, shell_of
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud

_FRAMES = [frame_along(axis) for axis in even_directions(26) if axis[2] > 0]  # initial directions tried
_MAX_POINTS = 120  # points used by one fit
_MIN_POINTS = 8  # with fewer the fruit stays a sphere
_NOISE = 0.0015  # metres: points farther off weigh less
_MIN_ALIGNMENT = 0.5  # cosine between normals and the spheroid's
_MIN_COVERAGE = 0.22  # fraction of a sphere that must show for a fruit to count towards the common ratio
_MIN_SKIN = 40  # points of skin that such a fruit needs
_MIN_FRUITS = 6  # such fruits needed
_STRETCHES = np.linspace(-0.4, 0.56, 9)  # values of log(length / width) tried
_MIN_STRETCH = 0.06  # absolute log(length / width) below which fruit is round
_MIN_SAVING = 0.06  # fraction of round fruit's cost that spheroids must save
_MAX_FRUITS = 12  # fruits used for the common ratio
_LEAN = 1.5  # standard deviation of an axis from the vertical, as a tangent: fruit hangs mostly upright
_PASSES = 3  # each finds the skin around the previous pass's spheroids
_ITERATIONS = 12
_STEP = 1e-5  # parameter step of finite differences
_LOG_WIDTH_DEVIATION = 0.15  # standard deviation of log(width / sphere's)


class Spheroid(NamedTuple):
    """A sphere stretched along an axis.

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
        """Semi-axes (3,) in metres, the last along the axis."""
        return self.width * np.array([1.0, 1.0, np.exp(self.stretch)])

    @property
    def radius(self) -> float:
        """Radius of the sphere of the same volume, metres."""
        return float(self.width * np.exp(self.stretch / 3))

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) whose last column is the axis."""
        return frame_along(self.axis)


def fit_spheroids(fits: Sequence[SphereFit], skin: SurfaceCloud) -> list[Spheroid] | None:
    """Fit spheroids of one ratio of length to width to spheres.

    Args:
        fits: The spheres found as fruit.
        skin: The points that may be fruit.

    Returns:
        A spheroid for each sphere, or None where the row's fruit is round.
    """
    tree = cKDTree(skin.points)
    spheroids = [Spheroid(fit.center, fit.radius, 0.0, np.array([0.0, 0.0, 1.0])) for fit in fits]
    is_round = True
    for _ in range(_PASSES):  # the ends of long fruit are too far from the initial spheres to count as their skin
        skins = _skins(spheroids, skin, tree)
        clear = [k for k, fit in enumerate(fits) if fit.coverage > _MIN_COVERAGE and len(skins[k]) >= _MIN_SKIN]
        stretch = _common_stretch(spheroids, skins, clear) if len(clear) >= _MIN_FRUITS else None
        if stretch is None:
            break
        spheroids, is_round = _fit(spheroids, skins, np.full(len(fits), stretch))[0], False
    return None if is_round else spheroids


def _common_stretch(fits: Sequence[Spheroid], skins: Sequence[Array], clear: Sequence[int]) -> float | None:
    """Return the log(length / width) that explains the skins of clearly visible fruits best; None if they are round."""
    used = clear[:: max(1, len(clear) // _MAX_FRUITS)]
    tried = np.repeat(_STRETCHES, len(used))
    count = len(_STRETCHES)
    costs = _fit([fits[k] for k in used] * count, [skins[k] for k in used] * count, tried)[1]
    costs = costs.reshape(count, -1).sum(axis=1)
    best = int(np.argmin(costs))
    stretch = float(_STRETCHES[best])
    if 0 < best < count - 1:  # the vertex of the parabola through the three lowest costs
        below, here, above = costs[best - 1 : best + 2]
        stretch += float(_STRETCHES[1] - _STRETCHES[0]) * float((below - above) / (2 * (below - 2 * here + above)))
    round_cost = float(np.interp(0.0, _STRETCHES, costs))
    return None if abs(stretch) < _MIN_STRETCH or costs[best] > (1 - _MIN_SAVING) * round_cost else stretch


def _skins(fits: Sequence[Spheroid], cloud: SurfaceCloud, tree: cKDTree) -> list[Array]:
    """Return for each spheroid the points (k, 3) near its surface that are nearest to it, at longest `_MAX_POINTS`."""
    longest = [1.3 * float(fit.semi_axes.max()) for fit in fits]
    near = [
        np.array(tree.query_ball_point(fit.center, r), dtype=np.int64) for fit, r in zip(fits, longest, strict=True)
    ]
    nearest = np.full(len(cloud), np.inf)
    residuals = []
    for fit, rows in zip(fits, near, strict=True):
        offset = cloud.points[rows] - fit.center
        axis, width, stretch = fit.axis[None], np.array([[fit.width]]), np.array([fit.stretch])
        residuals.append(_distances(offset[None], axis, width, stretch)[0])
        nearest[rows] = np.minimum(nearest[rows], np.abs(residuals[-1]))
    skins = []
    for fit, rows, residual in zip(fits, near, residuals, strict=True):
        offset = cloud.points[rows] - fit.center
        unit = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
        own = np.abs(residual) < max(shell_of(fit.radius), 0.2 * fit.radius)
        own &= (np.abs(residual) <= nearest[rows]) & ((unit * cloud.normals[rows]).sum(axis=1) > _MIN_ALIGNMENT)
        kept = rows[own]
        skins.append(cloud.points[kept[:: max(1, len(kept) // _MAX_POINTS)]])
    return skins


class _Problem(NamedTuple):
    """Spheroids (k,) to be refined, and the skin of each.

    The parameters (k, 6) are the center's displacement in centimetres, the log of the width's change, and two tilts.

    Attributes:
        centers: (k, 3) initial centers, metres.
        widths: (k,) initial widths, metres.
        stretches: (k,) fixed.
        points: (k, n, 3) metres, padded for skins with fewer points.
        real: (k, n) 1 for points, 0 for padding.
        frames: (k, 3, 3) whose last column is the initial axis.
    """

    centers: Array
    widths: Array
    stretches: Array
    points: Array
    real: Array
    frames: Array

    def axes(self, x: Array) -> Array:
        """Return the axes (k, 3) of the spheroids at parameters (k, 6)."""
        axes = (self.frames @ np.column_stack([x[:, 4:], np.ones(len(x))])[:, :, None])[:, :, 0]
        return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))

    def residuals(self, x: Array) -> Array:
        """Return residuals (k, n + 2) at parameters (k, 6): robust distances of points, then lean and width priors."""
        axes = self.axes(x)
        width = (self.widths * np.exp(x[:, 3]))[:, None]
        off = _distances(self.points - (self.centers + 0.01 * x[:, :3])[:, None], axes, width, self.stretches) / _NOISE
        off *= self.real / np.sqrt(1 + off**2 / 8)  # distant points weigh little more than moderately distant ones
        lean = np.hypot(axes[:, 0], axes[:, 1]) / np.maximum(np.abs(axes[:, 2]), 0.2)
        weight = 0.3 * np.sqrt(self.real.sum(axis=1))
        return np.column_stack([off, weight * lean / _LEAN, weight * x[:, 3] / _LOG_WIDTH_DEVIATION])


def _fit(fits: Sequence[Spheroid], skins: Sequence[Array], stretches: Array) -> tuple[list[Spheroid], Array]:
    """Fit spheroids of given stretches (k,) to their skins by Levenberg-Marquardt, and return them with costs (k,)."""
    longest = max((len(skin) for skin in skins), default=0)
    points, real = np.zeros((len(fits), max(longest, 1), 3)), np.zeros((len(fits), max(longest, 1)))
    for k, skin in enumerate(skins):
        if len(skin) >= _MIN_POINTS:
            points[k, : len(skin)], real[k, : len(skin)] = skin, 1.0
    centers, radii = np.array([f.center for f in fits]).reshape(-1, 3), np.array([f.radius for f in fits])
    points[real == 0] = np.repeat(centers, (real == 0).sum(axis=1), axis=0)
    widths = radii * np.exp(-stretches / 3)
    problem = _Problem(centers, widths, stretches, points, real, np.tile(_FRAMES[0], (len(fits), 1, 1)))
    x = np.zeros((len(fits), 6))
    tried = [
        (problem._replace(frames=np.tile(frame, (len(fits), 1, 1))).residuals(x) ** 2).sum(axis=1) for frame in _FRAMES
    ]
    problem = problem._replace(frames=np.array(_FRAMES)[np.argmin(tried, axis=0)])
    residuals = problem.residuals(x)
    damping = np.full(len(fits), 1e-3)
    for _ in range(_ITERATIONS):
        slopes = np.stack([(problem.residuals(x + step) - residuals) / _STEP for step in _STEP * np.eye(6)], axis=2)
        normal = slopes.transpose(0, 2, 1) @ slopes
        damped = damping[:, None, None] * normal * np.eye(6) + 1e-6 * np.eye(6)
        stepped = x - np.linalg.solve(normal + damped, slopes.transpose(0, 2, 1) @ residuals[:, :, None])[:, :, 0]
        after = problem.residuals(stepped)
        better = (after**2).sum(axis=1) < (residuals**2).sum(axis=1)
        x, residuals = np.where(better[:, None], stepped, x), np.where(better[:, None], after, residuals)
        damping = np.where(better, damping / 5, 5 * damping)
    widths = problem.widths * np.exp(x[:, 3])
    spheroids = map(Spheroid, centers + 0.01 * x[:, :3], widths.tolist(), stretches.tolist(), problem.axes(x))
    return list(spheroids), np.asarray((residuals**2).sum(axis=1))


def _distances(points: Array, axes: Array, widths: Array, stretches: Array) -> Array:
    """Return signed distances (k, n) of points from spheroids around the origin, to first order.

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
