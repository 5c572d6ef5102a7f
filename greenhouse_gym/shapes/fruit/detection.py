"""Detection of tomatoes: large fruit, small fruit, red fruit that both miss, their shape and their trusses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array, Ellipsoid, Sphere
from greenhouse_gym.shapes.colors import redness
from greenhouse_gym.shapes.fruit.flowers import flower_mask
from greenhouse_gym.shapes.fruit.large_fruit import ScoredFruit, fit_candidates, large_fruit, row_order
from greenhouse_gym.shapes.fruit.red_fruit import RedFruit, find_red, sits_on
from greenhouse_gym.shapes.fruit.small_fruit import find_small
from greenhouse_gym.shapes.fruit.spheres import SphereFit, is_separate
from greenhouse_gym.shapes.fruit.spheroids import Spheroid, fit_spheroids
from greenhouse_gym.shapes.fruit.trusses import group_trusses
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud

_REDNESS = np.array([-0.12, 0.07, 0.34, 0.77])
"""(R - G) / (R + G) of the skin at ripeness 0, 1/3, 2/3, 1: green, turning, orange, red."""

_CLEAR = 0.8  # confidence of red fruit that the networks missed


class FoundTomatoes(NamedTuple):
    """Tomatoes found in a cloud, and the confidence of each, 0 to 1."""

    tomatoes: tuple[Tomato, ...]
    confidence: tuple[float, ...]


class _Fruit(NamedTuple):
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
    fruits = [fruits[k] for k in row_order([fruit.sphere for fruit in fruits])]
    spheroids = fit_spheroids([fruit.sphere for fruit in fruits], candidates.skin)
    if spheroids is not None:
        kept = separate_spheroids(spheroids, np.array([fruit.confidence for fruit in fruits]))
        if len(kept) < len(fruits):
            fruits = [fruits[k] for k in kept]
            spheroids = fit_spheroids([fruit.sphere for fruit in fruits], candidates.skin)
    tomatoes = tuple(_tomatoes(fruits, spheroids, settings))
    return FoundTomatoes(tomatoes, tuple(fruit.confidence for fruit in fruits))


def find_red_tomatoes(surface: SurfaceCloud, settings: ShapeSettings) -> FoundTomatoes:
    """Find the red tomatoes in any cloud by geometry and redness alone; all are taken as round."""
    fruits = _red_fruits(surface, [], settings.min_confidence, settings)
    fruits = [fruits[k] for k in row_order([fruit.sphere for fruit in fruits])]
    return FoundTomatoes(tuple(_tomatoes(fruits, None, settings)), tuple(fruit.confidence for fruit in fruits))


def _red_fruits(
    surface: SurfaceCloud, found: Sequence[_Fruit], min_confidence: float, settings: ShapeSettings
) -> list[_Fruit]:
    """Return the red fruits that those found before do not explain."""
    red = find_red(surface, [fruit.sphere for fruit in found], settings)
    return [fruit for fruit in _fruits(red, surface) if fruit.confidence >= min_confidence]


def _fruits(found: ScoredFruit | RedFruit, cloud: SurfaceCloud) -> list[_Fruit]:
    """Return spheres among the points of a cloud with their ripeness."""
    return [
        _Fruit(fit, confidence, ripeness_of(cloud.colors[fit.points]))
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


def _tomatoes(fruits: Sequence[_Fruit], spheroids: list[Spheroid] | None, settings: ShapeSettings) -> Iterator[Tomato]:
    """Yield fruits as round tomatoes, or as ellipsoids where spheroids are given."""
    trusses = group_trusses(spheroids or [fruit.sphere for fruit in fruits], settings.truss_spread)
    for k, (fruit, truss) in enumerate(zip(fruits, trusses.tolist(), strict=True)):
        if spheroids is None:
            yield Tomato(Sphere(fruit.sphere.center, fruit.sphere.radius), truss, fruit.ripeness)
        else:
            own = spheroids[k]
            shape = Ellipsoid(own.center, own.semi_axes, own.rotation, own.radius)
            yield Tomato(shape, truss, fruit.ripeness)
