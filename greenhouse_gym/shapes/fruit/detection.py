"""Detection of tomatoes: large fruit, small fruit, red fruit that both miss, their shape and their trusses.

Flowers are small groups of petals, recognized by a yellow that is absent from leaves and rare on fruit.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array, Ellipsoid, Shape, Sphere
from greenhouse_gym.shapes.evidence import SHELL, nearest_shapes
from greenhouse_gym.shapes.fruit.large_fruit import ScoredFruit, fit_candidates, large_fruit, row_order
from greenhouse_gym.shapes.fruit.red_fruit import RedFruit, find_red, sits_on
from greenhouse_gym.shapes.fruit.small_fruit import find_small
from greenhouse_gym.shapes.fruit.spheres import SphereFit, is_separate, local_maxima
from greenhouse_gym.shapes.fruit.spheroids import Spheroid, fit_spheroids
from greenhouse_gym.shapes.fruit.trusses import group_trusses
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surface_cloud import Mask, SurfaceCloud, redness

_PETAL_REDNESS, _MAX_BLUE, _MIN_BRIGHTNESS = (-0.08, 0.13), 0.18, 0.3
"""Redness of petals, their blue as a fraction of the brightest channel, and this channel.

Petals of Helios' flowers have 0.05 and 0.05, photographed ones up to 0.08 and 0.17; turning fruit has 0.2 and more of
blue. On development rows 99 % of the points of this color lie on flowers.
"""

_MIN_PETALS = 0.25  # fraction of a sphere's points that are petals in a flower; fruit has at most 0.02
_MAX_FACING = 0.75  # fraction of the points in a sphere that lie on it and face outwards, from which it is yellow fruit
_FACING_COSINE = 0.8  # cosine between a point's normal and the sphere's
_FLOWER_RADIUS = 0.012  # metres: about that of a flower
_MIN_PETAL_COUNT = 10  # petals that make a flower
_FLOWERS_APART = 0.016  # metres between two flowers

_REDNESS = np.array([-0.12, 0.07, 0.34, 0.77])
"""(R - G) / (R + G) of the skin at ripeness 0, 1/3, 2/3, 1: green, turning, orange, red."""

_CLEAR = 0.8  # confidence of red fruit that the networks missed, and of fruit that shows that a truss is there
_SMALL, _GREEN = 0.012, 0.5  # largest radius in metres, and ripeness, of fruit that a bump of a leaf resembles
_MIN_SMALL, _MIN_MEAN = 5, 0.75
"""Number of small green fruit that shows by its mean confidence, and the least, if the row has such fruit.

Development rows have 0.86 to 1.0; crumpled leaves without fruit, which the networks do not know, 0.5 to 0.6.
"""


def petal_mask(colors: Array) -> Mask:
    """Return which colors (n, 3), RGB from 0 to 1, may be those of petals."""
    red, brightest = redness(colors), colors.max(axis=1, initial=0.0)
    yellow = (red > _PETAL_REDNESS[0]) & (red < _PETAL_REDNESS[1]) & (colors[:, 2] < _MAX_BLUE * brightest)
    return np.asarray(yellow & (brightest > _MIN_BRIGHTNESS))


def flower_mask(spheres: Sequence[Sphere], surface: SurfaceCloud) -> Mask:
    """Return which of k spheres, in the frame of the surface, lie on petals rather than on the round skin of fruit."""
    tree, petals = cKDTree(surface.points), petal_mask(surface.colors)
    flowers = np.zeros(len(spheres), dtype=np.bool_)
    for k, sphere in enumerate(spheres):
        near = np.array(tree.query_ball_point(sphere.center, sphere.radius + SHELL), dtype=np.int64)
        if petals[near].sum() <= _MIN_PETALS * len(near):
            continue
        offset = surface.points[near] - sphere.center
        distance = np.linalg.norm(offset, axis=1)
        outwards = (offset * surface.normals[near]).sum(axis=1) > _FACING_COSINE * distance
        flowers[k] = (outwards & (np.abs(distance - sphere.radius) < SHELL)).mean() < _MAX_FACING
    return flowers


def find_flowers(surface: SurfaceCloud, fruit: Sequence[Shape]) -> tuple[Sphere, ...]:
    """Return a ball of usual size around each group of petals away from fruit, in the frame of the surface, metres."""
    points = surface.points[petal_mask(surface.colors)]
    points = points[nearest_shapes(points, fruit, SHELL).owner < 0]
    if not len(points):
        return ()
    near = cKDTree(points).query_ball_point(points, _FLOWER_RADIUS)
    counts = np.array([len(rows) for rows in near])
    middles = np.array([points[rows].mean(axis=0) for rows in near])
    best = np.flatnonzero((counts >= _MIN_PETAL_COUNT) & local_maxima(middles, counts, _FLOWERS_APART))
    return tuple(Sphere(middles[k], _FLOWER_RADIUS) for k in best)


class FoundTomatoes(NamedTuple):
    """Tomatoes found in a cloud, the confidence of each, 0 to 1, and the number of `without_bumps` left out."""

    tomatoes: tuple[Tomato, ...]
    confidence: tuple[float, ...]
    bumps: int = 0


class Fruit(NamedTuple):
    """A sphere that is a tomato, its confidence and its ripeness."""

    sphere: SphereFit
    confidence: float
    ripeness: float


def find_tomatoes(surface: SurfaceCloud, fine: SurfaceCloud, settings: ShapeSettings) -> FoundTomatoes:
    """Find the tomatoes in a cloud that resembles those to which the networks were fitted.

    Args:
        surface: The cloud with a point per voxel of ``settings.voxel``.
        fine: The same with a point per voxel of ``settings.fine_voxel``, in which small fruit is searched.
        settings: All settings.
    """
    candidates = fit_candidates(surface, settings)
    large = large_fruit(candidates, settings)
    small = find_small(fine, large, settings)
    fruits = [*_fruits(large, candidates.skin), *_fruits(small, fine)]
    flowers = flower_mask([fruit.sphere for fruit in fruits], surface)
    fruits = [fruit for fruit, flower in zip(fruits, flowers, strict=True) if not flower]
    missed = _red_fruits(surface, fruits, _CLEAR, settings)
    large_red = [fruit.sphere for fruit in missed]
    fruits = [*(fruit for fruit in fruits if not sits_on(fruit.sphere, large_red)), *missed]
    found, fruits = len(fruits), without_bumps(fruits, settings)
    bumps = found - len(fruits)
    fruits = [fruits[k] for k in row_order([fruit.sphere for fruit in fruits])]
    spheroids = fit_spheroids([fruit.sphere for fruit in fruits], candidates.skin)
    if spheroids is not None:
        kept = separate_spheroids(spheroids, np.array([fruit.confidence for fruit in fruits]))
        if len(kept) < len(fruits):
            fruits = [fruits[k] for k in kept]
            spheroids = fit_spheroids([fruit.sphere for fruit in fruits], candidates.skin)
    tomatoes = tuple(_tomatoes(fruits, spheroids, settings))
    return FoundTomatoes(tomatoes, tuple(fruit.confidence for fruit in fruits), bumps)


def without_bumps(fruits: list[Fruit], settings: ShapeSettings) -> list[Fruit]:
    """Return fruits without small green ones far from sure ones, if their low scores show that the row has none."""
    small = np.array([fruit.sphere.radius < _SMALL and fruit.ripeness < _GREEN for fruit in fruits], dtype=bool)
    confidence = np.array([fruit.confidence for fruit in fruits])
    if np.count_nonzero(small) < _MIN_SMALL or confidence[small].mean() >= _MIN_MEAN:
        return fruits
    confident = [fruit.sphere for fruit in itertools.compress(fruits, ~small & (confidence >= _CLEAR))]
    centers = np.array([fruit.sphere.center for fruit in fruits])
    supported = nearest_shapes(centers, confident, settings.truss_spread).owner >= 0
    return list(itertools.compress(fruits, ~small | supported))


def find_red_tomatoes(surface: SurfaceCloud, settings: ShapeSettings) -> FoundTomatoes:
    """Find the red tomatoes in any cloud by geometry and redness alone; all are taken as round."""
    fruits = _red_fruits(surface, [], settings.min_confidence, settings)
    fruits = [fruits[k] for k in row_order([fruit.sphere for fruit in fruits])]
    return FoundTomatoes(tuple(_tomatoes(fruits, None, settings)), tuple(fruit.confidence for fruit in fruits))


def _red_fruits(
    surface: SurfaceCloud, found: Sequence[Fruit], min_confidence: float, settings: ShapeSettings
) -> list[Fruit]:
    """Return the red fruits that those found before do not explain."""
    red = find_red(surface, [fruit.sphere for fruit in found], settings)
    return [fruit for fruit in _fruits(red, surface) if fruit.confidence >= min_confidence]


def _fruits(found: ScoredFruit | RedFruit, cloud: SurfaceCloud) -> list[Fruit]:
    """Return spheres among the points of a cloud with their ripeness."""
    return [
        Fruit(fit, confidence, ripeness_of(cloud.colors[fit.points]))
        for fit, confidence in zip(found.fits, found.confidence.tolist(), strict=True)
    ]


def separate_spheroids(spheroids: Sequence[Spheroid], confidence: Array) -> list[int]:
    """Return the indices of spheroids, in their order, without those that overlap a more confident one.

    The two ends of a long fruit may have been found as a sphere each.
    """
    kept: list[int] = []
    spheres = [Sphere(spheroid.center, spheroid.radius) for spheroid in spheroids]
    for k in np.argsort(-confidence, kind="stable").tolist():
        if is_separate(spheres[k], [spheres[i] for i in kept]):
            kept.append(k)
    return sorted(kept)


def ripeness_of(colors: Array) -> float:
    """Return the ripeness, 0 to 1, of skin with colors (n, 3): by its median redness, which shading does not change."""
    return float(np.round(np.interp(np.median(redness(colors)), _REDNESS, np.linspace(0, 1, len(_REDNESS))), 3))


def _tomatoes(fruits: Sequence[Fruit], spheroids: list[Spheroid] | None, settings: ShapeSettings) -> Iterator[Tomato]:
    """Yield fruits as round tomatoes, or as ellipsoids where spheroids are given."""
    trusses = group_trusses(spheroids or [fruit.sphere for fruit in fruits], settings.truss_spread)
    for k, (fruit, truss) in enumerate(zip(fruits, trusses.tolist(), strict=True)):
        if spheroids is None:
            yield Tomato(Sphere(fruit.sphere.center, fruit.sphere.radius), truss, fruit.ripeness)
        else:
            own = spheroids[k]
            shape = Ellipsoid(own.center, own.semi_axes, own.rotation, own.radius)
            yield Tomato(shape, truss, fruit.ripeness)
