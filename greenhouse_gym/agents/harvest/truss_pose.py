"""Pose of a truss in an image: its fruit, which turn about its root as one, are fitted to red skin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.geometry.poses import rotation_angle

MIN_PIXELS = 8
"""Number of pixels that show a fruit or a truss."""

_NEAR = 0.02  # metres of skin from where a fruit was expected
_PIXEL = 0.9998  # cosine between the rays of a pixel and its neighbor
_CORE, _ON, _BEHIND = 0.85, 0.01, 0.025  # fraction of a disc that counts; metres from skin, and behind it
_AROUND, _TAKEN = 0.06, 0.005  # metres from fruit within which skin without a fruit counts; see `skin_of`
_STEPS, _ROBUST, _STIFF = 5, 0.006, 1e-3  # Gauss-Newton steps, metres of misfit that count half, and damping
_THROUGH, _BETTER, _MIN_DISC = 0.4, 0.3, 30  # fractions of pixels, and fewest ones, that make it search: see `fitted`
_RELIABLE = 0.4  # fraction of pixels from which a pose is reliable
_CLEARER, _JUMP = 0.05, 0.2  # fraction of pixels, and radians at most, by which a truss in view turns between images
_COST = 0.4  # fraction of pixels that a turn by a radian costs
_RISES, _SWINGS = np.linspace(-0.3, 1.05, 10), np.linspace(-0.54, 0.54, 7)  # radians since the scan
_FARTHEST = 1.3  # radians since the scan that a truss turns at most
_BEST = 3  # searched poses that are refined
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Truss:
    """Fruit that hang on a truss and are ripe, as scanned.

    Attributes:
        root: (3,) point about which the truss turns, metres.
        centers: (n, 3) their middles, metres.
        radii: (n,) their radii, metres.
    """

    root: Array
    centers: Array
    radii: Array

    def turned(self, turn: Array) -> Array:
        """Return the middles (n, 3) after a rotation (3, 3)."""
        return np.asarray(self.root + (self.centers - self.root) @ turn.T)


@dataclass(frozen=True)
class SkinImage:
    """A color and depth image.

    Attributes:
        origin: (3,) position of the camera, metres.
        directions: (m, 3) unit vectors from it through the pixels.
        ranges: (m,) distances to what they show, metres; infinite without a reading.
        skin: (m,) whether they show ripe skin.
    """

    origin: Array
    directions: Array
    ranges: Array
    skin: npt.NDArray[np.bool_]

    @property
    def points(self) -> Array:
        """(k, 3) points on ripe skin, metres."""
        return np.asarray(self.origin + self.ranges[self.skin, None] * self.directions[self.skin])

    def shows(self, points: Array) -> npt.NDArray[np.bool_]:
        """Return which points (n, 3) are inside of the image, whatever hides them."""
        offsets = points - self.origin
        along = offsets @ self.directions.T
        return np.asarray(along.max(axis=1) > _PIXEL * np.linalg.norm(offsets, axis=1))

    def around(self, center: Array, radius: float) -> SkinImage:
        """Return the pixels whose rays pass a ball."""
        offset = center - self.origin
        along = self.directions @ offset
        near = (offset @ offset - along * along < radius * radius) & (along > -radius)
        return SkinImage(self.origin, self.directions[near], self.ranges[near], self.skin[near])

    def depths(self, centers: Array, radii: Array) -> Array:
        """Return the distances (m, n) at which rays would meet the middle parts of fruit, infinite where they miss."""
        offsets = centers - self.origin
        along = self.directions @ offsets.T
        across = (offsets * offsets).sum(axis=1) - along * along
        hits = (across < (_CORE * radii) ** 2) & (along > 0)
        return np.where(hits, along - np.sqrt(np.maximum(radii * radii - across, 0.0)), np.inf)

    def seen(self, centers: Array, radii: Array) -> tuple[Array, Array, Array]:
        """Return numbers of pixels (n,) of the discs of fruit: all, those with their skin, and those behind them."""
        depths = self.depths(centers, radii)
        hits = np.isfinite(depths)
        beyond = self.ranges[:, None] - np.where(hits, depths, 0.0)
        shown = hits & (np.abs(beyond) < _ON) & self.skin[:, None]
        return hits.sum(axis=0), shown.sum(axis=0), (hits & (beyond > _BEHIND)).sum(axis=0)


def fitted(image: SkinImage, truss: Truss, turn: Array, others: Array, search: bool) -> tuple[Array, bool]:
    """Return the rotation (3, 3) since the scan of a truss in an image, and whether it explains most of the image.

    Where the image looks through its fruit and ``search`` is set, the truss has moved while it was out of view:
    it is sought in other poses, which have to match much better the farther away they are. The fit is that of iterative
    closest points (Besl and McKay 1992) with Cauchy weights, and a rotation about the root alone.

    Args:
        image: The image around the truss.
        truss: The truss.
        turn: Its rotation before; the new one is near by.
        others: (k,) distances of the image's skin from fruit of other trusses, metres.
        search: Whether to seek it elsewhere.
    """
    points = image.points
    best, here = turn, _matched(image, truss, turn, points, others)
    refined = _refined(truss, turn, points, others)
    if rotation_angle(refined) < _FARTHEST and rotation_angle(refined @ turn.T) < _JUMP:
        found = _matched(image, truss, refined, points, others)
        if found.score > here.score + _CLEARER * here.pixels:
            best, here = refined, found
    if not search or here.pixels < _MIN_DISC or here.through < _THROUGH * here.pixels:
        return best, here.pixels >= _MIN_DISC and here.shown - here.through > _RELIABLE * here.pixels
    outward = (truss.centers.mean(axis=0) - truss.root) * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(outward))
    level = np.cross(_UP, outward / length) if length > 1e-3 else np.array([0.0, -1.0, 0.0])
    poses = [rotation_about(_UP, swing) @ rotation_about(level, -rise) for rise in _RISES for swing in _SWINGS]

    def cost_adjusted(pose: Array) -> float:
        found = _matched(image, truss, pose, points, others)
        return found.score - _COST * found.pixels * rotation_angle(pose @ turn.T)

    order = np.argsort([-cost_adjusted(pose) for pose in poses], kind="stable")
    score = here.score + _BETTER * here.pixels
    for k in order[:_BEST].tolist():
        pose = _refined(truss, poses[k], points, others)
        if rotation_angle(pose) < _FARTHEST and cost_adjusted(pose) > score:
            best, score = pose, cost_adjusted(pose)
    return best, False


class _Match(NamedTuple):
    """Match of a pose and an image, in pixels.

    Attributes:
        score: Pixels of skin where a fruit is, less those behind it, less half of other skin near by.
        shown: Pixels of skin where a fruit is, those right on it.
        pixels: Pixels that the fruit would fill.
        through: Pixels that are seen behind them.
    """

    score: float
    shown: float
    pixels: int
    through: int


def _matched(image: SkinImage, truss: Truss, turn: Array, points: Array, others: Array) -> _Match:
    centers = truss.turned(turn)
    depths = image.depths(centers, truss.radii).min(axis=1)
    hits = np.isfinite(depths)
    beyond = image.ranges - np.where(hits, depths, 0.0)
    on_skin = hits & image.skin
    shown = float(np.maximum(1 - np.abs(beyond[on_skin]) / _ON, 0.0).sum())
    through = np.count_nonzero(hits & (beyond > _BEHIND))
    gaps = np.abs(cdist(points, centers) - truss.radii).min(axis=1)
    alone = np.count_nonzero((gaps < _AROUND) & (gaps > _ON) & (others > _ON))
    return _Match(shown - through - 0.5 * alone, shown, int(np.count_nonzero(hits)), int(through))


def _refined(truss: Truss, turn: Array, points: Array, others: Array) -> Array:
    """Return a rotation (3, 3) by robust least squares from the distances of skin to the nearest fruit."""
    for _ in range(_STEPS):
        centers = truss.turned(turn)
        rows, fruit, misfit = skin_of(points, centers, truss.radii, others, _NEAR)
        if len(rows) < MIN_PIXELS:
            break
        outward = points[rows] - centers[fruit]
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        slopes = np.cross(centers[fruit] - truss.root, outward)
        weighted = slopes / (1 + (misfit / _ROBUST) ** 2)[:, None]
        step = np.linalg.solve(weighted.T @ slopes + _STIFF * np.eye(3), weighted.T @ misfit)
        turn = rotation_about(step, float(np.linalg.norm(step))) @ turn if step.any() else turn
    return turn


def skin_of(
    points: Array, centers: Array, radii: Array, others: Array, near: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """Return which points (k, 3) belong to a truss, their fruit, and their distances outside of its surface, metres.

    Args:
        points: Points on skin.
        centers: (n, 3) middles of its fruit.
        radii: (n,) their radii.
        others: (k,) distances of the points from fruit of other trusses, which have them if they are nearer.
        near: Largest distance.
    """
    outside = cdist(points, centers) - radii
    fruit = np.abs(outside).argmin(axis=1)
    misfit = outside[np.arange(len(points)), fruit]
    rows = np.flatnonzero((np.abs(misfit) < near) & (np.abs(misfit) <= np.abs(others) + _TAKEN))
    return rows, fruit[rows], misfit[rows]
