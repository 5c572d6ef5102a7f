"""Tomatoes: skin-colored spheres, the most credible first, grouped into trusses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array, Ellipsoid, Sphere
from greenhouse_gym.shapes.agreement import Find, agreed
from greenhouse_gym.shapes.candidates import COMPANY, MEASURES, MOST_CONTRAST, company, measures
from greenhouse_gym.shapes.colors import could_be_fruit, redness
from greenhouse_gym.shapes.credibility import ALONE, BESIDE, IN_ROW, Judges, credibility, judged, shipped_judges
from greenhouse_gym.shapes.ellipsoids import Spheroid, stretched
from greenhouse_gym.shapes.grids import Grid
from greenhouse_gym.shapes.second_look import look_again
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.small_fruit import Credited, find_small
from greenhouse_gym.shapes.spheres import SphereFit, all_apart, fit_spheres, vote
from greenhouse_gym.shapes.surfaces import SurfaceCloud
from greenhouse_gym.shapes.surroundings import surroundings
from greenhouse_gym.shapes.trusses import group_neighbors, group_trusses

_REDNESS = np.array([-0.12, 0.07, 0.34, 0.77])
"""(R - G) / (R + G) of the skin at ripeness 0, 1/3, 2/3, 1: green, turning, orange, red."""

_SURE = 0.8
"""How credible a tomato must be for others to be looked for beside it."""

_DOUBTED = 0.1
"""How credible a tomato must be to one grid for what the others say of it to count."""

_LONE_BEND = 0.2
"""Times its sphere's bend, the way that it bends less, of the surface of a fruit that nothing sure hangs beside; stems
have less. Where little of a fruit shows its bends are not known well, so one that is sure and redder than leaves need
have neither this nor ``ShapeSettings.least_bend``."""

_CONTRAST = MEASURES.index("contrast")
_SMALLER_BEND = MEASURES.index("smaller bend")
_PATCH_BEND = MEASURES.index("patch's smaller bend")
_NEIGHBORS = len(MEASURES) + COMPANY.index("neighbors")


class FoundTomatoes(NamedTuple):
    """Tomatoes found in a cloud, each with how credible it is, 0 to 1."""

    tomatoes: tuple[Tomato, ...]
    confidence: tuple[float, ...]


def find_tomatoes(grids: Sequence[Grid], settings: ShapeSettings) -> FoundTomatoes:
    """Find tomatoes in a cloud.

    Args:
        grids: The cloud by one grid of voxels or several.
        settings: All settings.
    """
    finds = agreed([_found_by(grid, settings) for grid in grids], settings.min_confidence)
    finds = [finds[k] for k in in_order([find.ball for find in finds])]
    skin = _skin(grids[0].surface, settings)
    spheroids = stretched([find.ball for find in finds], skin, settings)
    if spheroids is not None:
        kept = one_in_each_place(spheroids, np.array([find.confidence for find in finds]))
        if len(kept) < len(finds):
            finds = [finds[k] for k in kept]
            spheroids = stretched([find.ball for find in finds], skin, settings)
    return FoundTomatoes(tuple(_tomatoes(finds, spheroids, settings)), tuple(find.confidence for find in finds))


def _found_by(grid: Grid, settings: ShapeSettings) -> list[Find]:
    """What may be a tomato by one grid, be it hardly credible."""
    lenient = replace(settings, min_confidence=min(settings.min_confidence, _DOUBTED))
    looks = look(grid.surface, settings)
    large = large_tomatoes(looks, lenient)
    small = find_small(grid.fine, large.above(settings.min_confidence), lenient)
    return [
        Find(replace(fit, center=fit.center - grid.shift), credible, ripeness_of(cloud.colors[fit.points]))
        for found, cloud in ((large, looks.skin), (small, grid.fine))
        for fit, credible in zip(found.fits, found.confidence.tolist(), strict=True)
    ]


def one_in_each_place(spheroids: Sequence[Spheroid], confidence: Array) -> list[int]:
    """Indices of spheroids, in their order, without those in the place of a more credible one.

    The two ends of a long fruit may have been found as a ball each.
    """
    kept: list[int] = []
    balls = [Sphere(spheroid.center, spheroid.radius) for spheroid in spheroids]
    for k in np.argsort(-confidence, kind="stable").tolist():
        if all_apart(balls[k], [balls[i] for i in kept]):
            kept.append(k)
    return sorted(kept)


def large_tomatoes(looks: Looks, settings: ShapeSettings, judges: Judges | None = None) -> Credited:
    """The tomatoes that the first two looks show.

    Args:
        looks: What they show.
        settings: All settings.
        judges: Who judges beside the regressions; the networks that are shipped when left out.
    """
    judges = judges or shipped_judges()
    first, second = judged(looks.first, IN_ROW, judges.first), judged(looks.second, BESIDE, judges.second)
    alone = looks.first[:, _NEIGHBORS] == 0
    unbent = looks.first[:, _PATCH_BEND] < settings.least_bend
    unbent |= looks.first[:, _SMALLER_BEND] < _LONE_BEND
    red = (looks.first[:, _CONTRAST] >= MOST_CONTRAST) & (first >= _SURE)
    credible = np.concatenate([np.where(alone & unbent & ~red, 0.0, first), second]).tolist()
    fits = [*looks.fits, *looks.beside]
    found = choose(fits, credible, len(looks.skin), settings.min_confidence)
    confidence = dict(zip(fits, credible, strict=True))
    return Credited(found, np.array([confidence[fit] for fit in found]), _tones_of(found, looks.skin))


def _tomatoes(finds: Sequence[Find], spheroids: list[Spheroid] | None, settings: ShapeSettings) -> Iterator[Tomato]:
    """Spheres as tomatoes, or the spheroids that the row's fruit is."""
    trusses = group_trusses([find.ball for find in finds] if spheroids is None else spheroids, settings.truss_spread)
    for k, (find, truss) in enumerate(zip(finds, trusses.tolist(), strict=True)):
        if spheroids is None:
            yield Tomato(Sphere(find.ball.center, find.ball.radius), truss, find.ripeness)
        else:
            own = spheroids[k]
            shape = Ellipsoid(own.center, own.semi_axes, own.rotation, own.radius)
            yield Tomato(shape, truss, find.ripeness)


class Looks(NamedTuple):
    """What a first look at a cloud and a second one at its trusses show.

    Attributes:
        skin: The points that may be fruit.
        fits: Spheres of the first look, among ``skin``.
        first: Measures (k, m) of these: by themselves, in company, and of their surroundings.
        beside: Spheres of the second look, among ``skin``.
        second: Measures (j, m) of these.
    """

    skin: SurfaceCloud
    fits: list[SphereFit]
    first: Array
    beside: list[SphereFit]
    second: Array


def look(cloud: SurfaceCloud, settings: ShapeSettings) -> Looks:
    """Fit spheres to a cloud, and measure them by themselves and by those that are sure."""
    skin = _skin(cloud, settings)
    fits = fit_spheres(skin.points, skin.normals, vote(skin.points, skin.normals, settings), settings)
    alone = measures(fits, cloud, settings)
    sure = choose(fits, credibility(alone, ALONE).tolist(), len(skin), _SURE)
    trusses = group_neighbors(sure, settings.truss_gap)
    beside = look_again(skin.points, skin.normals, skin.tones, sure, trusses, settings)

    def in_full(fits: list[SphereFit], alone: Array) -> Array:
        tones, sure_tones = _tones_of(fits, skin), _tones_of(sure, skin)
        around = surroundings(fits, cloud, settings.voxel)
        return np.column_stack([alone, company(fits, tones, sure, sure_tones, settings), around])

    return Looks(skin, fits, in_full(fits, alone), beside, in_full(beside, measures(beside, cloud, settings)))


def _skin(cloud: SurfaceCloud, settings: ShapeSettings) -> SurfaceCloud:
    """The points that may be fruit."""
    return cloud.select(could_be_fruit(cloud, settings))


def choose(fits: list[SphereFit], credible: list[float], count: int, least: float) -> list[SphereFit]:
    """Keep credible fits that no better one explains: best first, each must own most of its points.

    Args:
        fits: Spheres among the same points.
        credible: How credible each is, 0 to 1.
        count: Number of the points.
        least: How credible a fit must be.
    """
    owned = np.zeros(count, dtype=bool)
    chosen: list[int] = []
    for k in np.argsort(-np.array(credible), kind="stable").tolist():
        if credible[k] < least:
            break
        apart = all_apart(fits[k], [fits[i] for i in chosen])
        if apart and np.count_nonzero(~owned[fits[k].points]) > 0.6 * len(fits[k].points):
            owned[fits[k].points] = True
            chosen.append(k)
    found = [fits[k] for k in chosen]
    return [found[k] for k in in_order(found)]


def in_order(fits: Sequence[Sphere]) -> list[int]:
    """Indices of spheres from one end of the row to the other."""
    return sorted(range(len(fits)), key=lambda k: tuple(np.round(fits[k].center[[1, 2, 0]], 3)))


def _tones_of(fits: Sequence[SphereFit], cloud: SurfaceCloud) -> Array:
    """Redness (k,) of spheres among the points of a cloud, each in the middle."""
    return np.array([np.median(cloud.tones[fit.points]) for fit in fits])


def ripeness_of(colors: Array) -> float:
    """Ripeness, 0 to 1, from the skin's colors (n, 3): by the median of (R - G) / (R + G), which ignores shading."""
    return float(np.round(np.interp(np.median(redness(colors)), _REDNESS, np.linspace(0, 1, len(_REDNESS))), 3))
