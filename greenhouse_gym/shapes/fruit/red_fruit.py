"""Red fruit of any size from its skin and outline alone, without learned scores, for clouds of any sensor.

The depth of a noisy sensor shows neither the curvature of a small fruit nor the size of a large one, but the outline
of red skin shows both. So balls of every radius are laid behind the red points, and each is compared with the cloud as
its viewer saw it: the area where red skin lies on the ball counts for it; the area where something else or nothing was
measured, and red skin that continues outside, count against it. What hides a ball counts little. A small ball on the
skin of a large one explains less and loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.geometry.point_clouds import Cloud, group_sizes, voxel_means
from greenhouse_gym.shapes.evidence import SHELL, nearest_shapes
from greenhouse_gym.shapes.fruit.spheres import SphereFit
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surface_cloud import Mask, SurfaceCloud, redness

RED = 0.22
"""(R - G) / (R + G) above which skin is red: about half way from leaves to ripe fruit."""

_NOISE_REACH = 7.0  # radius of the smallest fruit, and of the patch that noise may fake, in standard deviations
_MIN_VOXELS = 3.0  # radius, in voxels, of the smallest fruit whose outline the cloud resolves
_RADIUS_STEP = 1.28  # ratio of the radii tried
_CELL = 1 / 6  # side of the cells in which the cloud is compared with a ball, in radii
_SPACING = 0.6  # distance between the points at which balls are laid, in radii
_GRID, _REACH = 13, 1.25  # cells across a ball's picture, and half its width in radii
_SHELL, _SHELL_BOUNDS = 0.2, (0.003, 0.009)  # distance from a ball at which points are its skin: radii, metres
_HIDDEN, _OUTSIDE = 0.3, 0.3  # weights of hidden area and of skin that continues, against that of area on the ball
_MIN_FILLED, _MIN_PURITY = 0.25, 0.6  # fraction of a ball's picture that is skin, and of what is not hidden
_MAX_OUTSIDE, _MIN_BULGE = 0.5, 0.2  # skin that continues, and curvature: a red wall has 1 and 0
_SEPARATION = 0.8  # distance of two balls' centers, as a fraction of the sum of their radii
_MAX_OWNED = 0.4  # fraction of a ball's skin that may belong to others
_SIZE_SPREAD = 0.25  # standard deviation of the logarithm of a row's radii
_SHIFTS = 0.15 * np.array([[0, 0, 0], *np.eye(3), *-np.eye(3)])  # moves tried in refinement, in radii
_SCALES = np.array([-0.12, -0.06, 0.0, 0.06, 0.12])  # changes of the radius tried in refinement
_ROUNDS = 3
_VIEW_CELL, _VIEW_REACH = 0.1, 0.25  # metres: normals are averaged over these to learn from where a part was seen
_BATCH = 400

_TICKS = (np.arange(_GRID) + 0.5) / _GRID * 2 * _REACH - _REACH
_FROM_CENTER = np.hypot(*np.meshgrid(_TICKS, _TICKS)).ravel()
_DISC, _RING = _FROM_CENTER < 1.0, (_FROM_CENTER >= 1.05) & (_FROM_CENTER < 1.3)


Rows = npt.NDArray[np.int64]


class RedFruit(NamedTuple):
    """Balls of red skin (k,) among the points of a surface, and the confidence of each, 0 to 1."""

    fits: list[SphereFit]
    confidence: Array


class _Balls(NamedTuple):
    """Balls (k,) and the evidence for each in the cloud.

    Attributes:
        centers: (k, 3) metres.
        radii: (k,) metres.
        skin: (k,) fraction of a ball's picture that is red skin at the right depth.
        other: (k,) fraction where something else, or nothing, was measured.
        hidden: (k,) fraction hidden by something in front.
        outside: (k,) fraction of a ring around it where red skin continues.
        off: (k,) mean distance of the skin from the ball, in radii.
        bulge: (k,) by how much the skin recedes toward the outline: 0 for a plane, 0.5 and more for a ball.
    """

    centers: Array
    radii: Array
    skin: Array
    other: Array
    hidden: Array
    outside: Array
    off: Array
    bulge: Array

    @property
    def gain(self) -> Array:
        """Area (k,) for a ball less that against it, square metres."""
        net = self.skin - self.other - _HIDDEN * self.hidden - _OUTSIDE * self.outside
        return np.asarray(np.pi * self.radii**2 * net * (1 - self.off))

    def rank(self, usual: float | None) -> Array:
        """Return the gain (k,), less for radii unlike the usual one as far as a ball does not show its own size."""
        if usual is None:
            return self.gain
        unlike = np.log(self.radii / usual) ** 2 / (2 * _SIZE_SPREAD**2)
        return np.asarray(self.gain * np.exp(-(1 - self.skin) * unlike))

    def confidence(self, noise: Array) -> Array:
        """Return the fraction (k,) of skin in the visible area, less where noise (k,), metres, could fake that area."""
        area, faked = np.pi * self.radii**2, np.pi * (_NOISE_REACH * noise) ** 2
        return np.asarray(area * self.skin / (area * (self.skin + self.other) + faked))

    def select(self, rows: Rows) -> _Balls:
        return _Balls(*(values[rows] for values in self))


def _joined(parts: Sequence[_Balls]) -> _Balls:
    return _Balls(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def find_red(surface: SurfaceCloud, found: Sequence[Sphere], settings: ShapeSettings) -> RedFruit:
    """Find balls of red skin that fruit found before does not explain.

    Args:
        surface: The cloud with a point per voxel of ``settings.voxel``.
        found: Fruit found before. A ball may cover smaller ones; `sits_on` says which.
        settings: All settings.
    """
    lowest = max(settings.radii[0], _MIN_VOXELS * settings.voxel)
    smallest = np.maximum(lowest, _NOISE_REACH * surface.noises)
    red = redness(surface.colors) > RED
    here = cKDTree(surface.points)
    clear = [f for f in found if f.radius > smallest[here.query(f.center)[1]]]
    explained = nearest_shapes(surface.points, clear, SHELL).owner >= 0
    left = np.flatnonzero(red & ~explained & (smallest < settings.radii[1]))
    if len(left):
        left = left[group_sizes(surface.points[left], 2 * settings.voxel) * settings.voxel**2 > smallest[left] ** 2]
    if not len(left):
        return RedFruit([], np.zeros(0))
    seen_from = _Views(surface)
    near = cKDTree(surface.points[left]).query(surface.points, distance_upper_bound=3 * settings.radii[1])[0]
    around = np.flatnonzero(np.isfinite(near))
    scene, is_red, unexplained = surface.select(around), red[around], np.isin(around, left)
    low = float(smallest[left].min())
    steps = 1 + int(np.log(settings.radii[1] / low) / np.log(_RADIUS_STEP))
    laid = []
    for radius in np.geomspace(low, settings.radii[1], steps):
        shows = unexplained & (smallest[around] <= 1.01 * radius)  # noise hides smaller ones
        laid.append(_lay(scene, is_red, shows, float(radius), seen_from))
    balls = _joined(laid)
    tree = cKDTree(scene.points[is_red])
    owned = ~unexplained[is_red]
    chosen = _select(balls, tree, owned)
    if not len(chosen.radii):
        return RedFruit([], np.zeros(0))
    usual = _usual_radius(chosen)
    chosen = _select(balls, tree, owned, usual)
    spheres = np.column_stack([chosen.centers, chosen.radii])
    largest = 1.1 * settings.radii[1]
    refined = [_refine(scene, is_red, sphere, seen_from, usual, largest) for sphere in spheres]
    chosen = _select(_joined(refined), tree, owned, usual)
    chosen = chosen.select(np.flatnonzero(chosen.radii < 0.99 * largest))  # the others would have grown on
    rows = around[is_red]
    fits = [_as_fit(chosen, k, tree, rows, scene.normals[is_red]) for k in range(len(chosen.radii))]
    noise = surface.noises[here.query(chosen.centers)[1]]
    return RedFruit(fits, chosen.confidence(noise))


def sits_on(small: Sphere, balls: Sequence[Sphere]) -> bool:
    """Return whether a sphere is a bump on a much larger ball."""
    larger = (ball for ball in balls if ball.radius > 2 * small.radius)
    return any(np.linalg.norm(small.center - ball.center) < ball.radius + small.radius for ball in larger)


class _Views:
    """Directions from which the parts of a cloud were seen: the means of the normals around them."""

    def __init__(self, cloud: Cloud):
        cells, _ = voxel_means(Cloud(cloud.points, cloud.colors, cloud.normals), _VIEW_CELL)
        self._tree = cKDTree(cells.points)
        near = self._tree.query_ball_point(cells.points, _VIEW_REACH)
        means = np.array([cells.normals[rows].mean(axis=0) for rows in near])
        self._views = means / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-9)

    def __call__(self, points: Array) -> Array:
        """Return unit vectors (n, 3) toward the viewer at points (n, 3)."""
        return np.asarray(self._views[self._tree.query(points)[1]])


def _cells(cloud: Cloud, red: Mask, size: float) -> Cloud:
    """Return the cloud's mean points per cell, with the fraction of red points as color."""
    return voxel_means(Cloud(cloud.points, np.repeat(red[:, None], 3, axis=1).astype(float), cloud.normals), size)[0]


def _lay(cloud: Cloud, red: Mask, start: Mask, radius: float, seen_from: _Views) -> _Balls:
    """Lay balls behind the red points at ``start``: against the view, and half way to their normals."""
    poles = _cells(cloud.select(start), red[start], _SPACING * radius)
    views = seen_from(poles.points)
    turned = views + poles.normals
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    centers = np.concatenate([poles.points - radius * views, poles.points - radius * turned])
    return _compare(_cells(cloud, red, _CELL * radius), centers, np.concatenate([views, views]), radius)


def _refine(cloud: Cloud, red: Mask, ball: Array, seen_from: _Views, usual: float, largest: float) -> _Balls:
    """Move and scale a ball (4,) to where its rank is highest."""
    view = seen_from(ball[None, :3])
    near = np.flatnonzero(np.linalg.norm(cloud.points - ball[:3], axis=1) < 4 * ball[3])
    cells = _cells(cloud.select(near), red[near], _CELL * ball[3])
    for k in range(_ROUNDS):
        tried = []
        for scale in 1 + 0.8**k * _SCALES:
            centers = ball[:3] + 0.7**k * ball[3] * _SHIFTS @ _picture_axes(view)[:, 0]
            radius = min(float(ball[3] * scale), largest)
            tried.append(_compare(cells, centers, np.repeat(view, len(centers), axis=0), radius))
        balls = _joined(tried)
        best = balls.select(np.array([np.argmax(balls.rank(usual))]))
        ball = np.append(best.centers[0], best.radii[0])
    return best


def _picture_axes(views: Array) -> Array:
    """Return two axes across each of the views (k, 3), and the view: (3, k, 3)."""
    right = np.cross(views, [0.0, 0.0, 1.0]) + 1e-9 * np.array([0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(views, right), views])


def _compare(cells: Cloud, centers: Array, views: Array, radius: float) -> _Balls:
    """Compare balls of one radius with a cloud's cells as seen along their views (k, 3)."""
    tree = cKDTree(cells.points)
    parts = [
        _pictures(cells, tree, centers[k : k + _BATCH], views[k : k + _BATCH], radius)
        for k in range(0, len(centers), _BATCH)
    ]
    return _Balls(centers, np.full(len(centers), radius), *np.concatenate([np.zeros((0, 6)), *parts]).T)


def _pictures(cells: Cloud, tree: cKDTree, centers: Array, views: Array, radius: float) -> Array:
    """Return the last six columns of `_Balls` for balls (k,), from a picture of each in `_GRID` squared cells."""
    around = tree.query_ball_point(centers, 1.4 * radius)
    ahead = tree.query_ball_point(centers + 1.9 * radius * views, 1.6 * radius)
    lists = [*around, *ahead]
    owner = np.repeat(np.tile(np.arange(len(centers)), 2), [len(rows) for rows in lists])
    rows = np.concatenate(lists).astype(np.int64)
    offset = (cells.points[rows] - centers[owner]) / radius
    x, y, depth = ((offset * axis[owner]).sum(axis=1) for axis in _picture_axes(views))
    column, line = (np.floor((v + _REACH) / (2 * _REACH) * _GRID).astype(np.int64) for v in (x, y))
    inside = (np.minimum(column, line) >= 0) & (np.maximum(column, line) < _GRID)
    owner, x, y, depth = owner[inside], x[inside], y[inside], depth[inside]
    pixel = (owner * _GRID + column[inside]) * _GRID + line[inside]
    red, distance = cells.colors[rows[inside], 0] > 0.5, np.linalg.norm(offset[inside], axis=1)
    shell = float(np.clip(_SHELL * radius, *_SHELL_BOUNDS)) / radius
    skin = red & (np.abs(distance - 1) < shell) & (depth > -0.3)
    ahead_of = (distance > 1 + shell) & (depth**2 > 1 - x**2 - y**2) & (depth > 0)
    other = ~skin & ~ahead_of & (depth > -1.4) & ((depth > -0.2) | (distance < 1 - shell))

    def counts(mask: Mask) -> Rows:
        return np.bincount(pixel[mask], minlength=len(centers) * _GRID**2).reshape(len(centers), -1)

    skins, others, hiding = counts(skin), counts(other), counts(ahead_of) > 0
    filled = (skins > 0) & (skins >= others)
    hidden = ~filled & hiding
    continues = (counts(red & (np.abs(depth) < 0.6)) > 0) & ~hidden

    def mean(mask: Mask, values: Array) -> Array:
        count = np.bincount(owner[mask], minlength=len(centers))
        return np.asarray(np.bincount(owner[mask], values[mask], len(centers)) / np.maximum(count, 1))

    aside = x**2 + y**2
    patch = red & (aside < 1) & (np.abs(depth - 0.5) < 0.8)  # skin and, on a wall, what is no skin
    far, spread = mean(patch, aside), mean(patch, aside**2) - mean(patch, aside) ** 2
    bulge = (far * mean(patch, depth) - mean(patch, aside * depth)) / np.maximum(spread, 1e-3)
    off = mean(skin, np.abs(distance - 1))
    fractions = [picture[:, part].mean(axis=1) for picture, part in (
        (filled, _DISC), (~filled & ~hiding, _DISC), (hidden, _DISC), (continues, _RING),
    )]  # fmt: skip
    return np.column_stack([*fractions, off, bulge])


def _usual_radius(balls: _Balls) -> float:
    """Return the median radius of balls, weighted by their gain."""
    order = np.argsort(balls.radii)
    total = np.cumsum(balls.gain[order])
    return float(balls.radii[order[np.searchsorted(total, total[-1] / 2)]])


def _select(balls: _Balls, tree: cKDTree, owned: Mask, usual: float | None = None) -> _Balls:
    """Select balls greedily by their rank, separate from each other and with most of their skin to themselves."""
    purity = balls.skin / np.maximum(balls.skin + balls.other, 1e-9)
    is_ball = (balls.outside < _MAX_OUTSIDE) & (balls.bulge > _MIN_BULGE)
    is_ball &= (balls.skin > _MIN_FILLED) & (purity > _MIN_PURITY) & (balls.gain > 0)
    balls = balls.select(np.flatnonzero(is_ball))
    owned, chosen = owned.copy(), list[int]()
    for k in np.argsort(-balls.rank(usual), kind="stable").tolist():
        apart = np.linalg.norm(balls.centers[chosen] - balls.centers[k], axis=1)
        skin = tree.query_ball_point(balls.centers[k], 1.15 * balls.radii[k])
        if (apart > _SEPARATION * (balls.radii[chosen] + balls.radii[k])).all() and owned[skin].mean() < _MAX_OWNED:
            owned[tree.query_ball_point(balls.centers[k], 1.3 * balls.radii[k])] = True
            chosen.append(k)
    return balls.select(np.array(chosen, dtype=np.int64))


def _as_fit(balls: _Balls, k: int, tree: cKDTree, rows: Rows, normals: Array) -> SphereFit:
    """Return a ball with its points among ``rows``, the red points in the tree, with normals."""
    center, radius = balls.centers[k], float(balls.radii[k])
    near = np.array(tree.query_ball_point(center, 1.2 * radius), dtype=np.int64)
    offset = np.asarray(tree.data)[near] - center
    distance = np.linalg.norm(offset, axis=1)
    on = np.abs(distance - radius) < _SHELL * radius
    cosine = (offset[on] * normals[near[on]]).sum(axis=1) / distance[on]
    rmse = float(np.sqrt(np.mean((distance[on] - radius) ** 2)))
    return SphereFit(center, radius, rows[near[on]], float(balls.skin[k] / 2), rmse, float(cosine.mean()))
