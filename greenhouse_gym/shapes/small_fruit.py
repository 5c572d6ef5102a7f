"""A third look for small fruit, at a finer cloud: what takes a few voxels of the coarse one hardly bends there.

Young fruit may be greener than leaves and as bent as their tips, so neither color nor curvature alone tells it. Spheres
of small radii are voted for by all that bends one way at least, and a small network says which of them are fruit. What
it is sure of is company to the others, so a truss of young fruit is judged as a whole, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.candidates import company, measures
from greenhouse_gym.shapes.colors import is_colorful
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import IN_SHAPE, SphereFit, all_apart, crowded, fit_spheres, peaks
from greenhouse_gym.shapes.surfaces import NO_LEAF, SurfaceCloud
from greenhouse_gym.shapes.surroundings import surroundings

_RADII = 8  # radii that are tried, half of them in each octave
_BENDS = (35.0, 20.0)  # 1/m: what bends less even the one way does not vote for the radii of an octave
_GREENER = 0.06  # what is greener than the leaves by more, as (R - G) / (R + G), is no fruit
_SCORE, _FEWEST = 0.15, 6  # share of a half sphere's points that vote for its center, and how many at least
_LARGEST_CELL = 0.004  # metres: side of the cells in which votes are counted
_SURE = 0.7  # how credible small fruit must be to be company to others
_EXPLAINED = 0.4  # share of its points that larger fruit may explain


class Credited(NamedTuple):
    """Tomatoes that were found: spheres (k,), how credible each is, 0 to 1, and how red it is in the middle."""

    fits: list[SphereFit]
    confidence: Array
    tones: Array

    def above(self, least: float) -> Credited:
        """Those that are as credible as that at least."""
        rows = np.flatnonzero(self.confidence >= least)
        return Credited([self.fits[k] for k in rows], self.confidence[rows], self.tones[rows])


class Small(NamedTuple):
    """Small spheres (k,) in a fine cloud, their measures (k, m) by themselves, and how red each is in the middle."""

    fine: SurfaceCloud
    fits: list[SphereFit]
    alone: Array
    tones: Array

    def beside(self, found: Credited, chosen: Sequence[int], settings: ShapeSettings) -> Array:
        """Measures (k, m) of the spheres beside those found, and beside those chosen among themselves."""
        sure = [*found.fits, *(self.fits[k] for k in chosen)]
        tones = np.concatenate([found.tones, self.tones[list(chosen)]])
        return np.column_stack([self.alone, company(self.fits, self.tones, sure, tones, settings)])


def find_small(
    fine: SurfaceCloud, found: Credited, settings: ShapeSettings, judge: Callable[[Array], Array] | None = None
) -> Credited:
    """Find small fruit beside what was found; none where there are neither leaves nor larger fruit, or none is wanted.

    Args:
        fine: A point per voxel of ``settings.fine_voxel``.
        found: The tomatoes that two looks have found.
        settings: All settings.
        judge: Says how credible spheres are by their measures; the network that is shipped when left out.

    Returns:
        Spheres among the points of ``fine``.
    """
    table = fine.leaf == NO_LEAF and not found.fits  # things on it may be small and round, too
    if table or settings.small_radii is None or not len(fine):
        return Credited([], np.zeros(0), np.zeros(0))
    return chosen_small(small_spheres(fine, settings), found, settings, judge or network("small_fruit"))


def chosen_small(small: Small, found: Credited, settings: ShapeSettings, judge: Callable[[Array], Array]) -> Credited:
    """Those of the small spheres that are fruit."""
    confidence = judge(small.beside(found, sure_small(small, found, settings, judge), settings))
    chosen = _chosen(small, confidence, found, settings.min_confidence, settings)
    return Credited([small.fits[k] for k in chosen], confidence[chosen], small.tones[chosen])


def sure_small(small: Small, found: Credited, settings: ShapeSettings, judge: Callable[[Array], Array]) -> list[int]:
    """Indices of the small spheres that are fruit for sure, whatever others there are."""
    return _chosen(small, judge(small.beside(found, [], settings)), found, _SURE, settings)


def small_spheres(fine: SurfaceCloud, settings: ShapeSettings) -> Small:
    """All small spheres in a fine cloud."""
    assert settings.small_radii is not None
    low, high = settings.small_radii
    bounds = replace(settings, radii=(0.8 * low, 1.2 * high))
    candidates = _vote(fine, np.geomspace(low, high, _RADII), settings)
    fits = fit_spheres(fine.points, fine.normals, candidates, bounds, IN_SHAPE)
    tones = np.array([np.median(fine.tones[fit.points]) for fit in fits])
    alone = np.column_stack([measures(fits, fine, settings), surroundings(fits, fine, settings.fine_voxel)])
    return Small(fine, fits, alone, tones)


def _vote(fine: SurfaceCloud, radii: Array, settings: ShapeSettings) -> Array:
    """Candidate spheres (k, 4) of some radii (r,), metres, at the peaks of the votes, octave by octave."""
    able = is_colorful(fine.colors, settings) & (fine.tones > fine.leaf - _GREENER)
    found = []
    for some, bend in zip(np.split(radii, len(_BENDS)), _BENDS, strict=True):
        rows = np.flatnonzero(able & (fine.bends[:, 1] > bend))
        candidates, shares = [np.zeros((0, 4))], [np.zeros(0)]
        for radius in some if len(rows) else ():
            full = 2 * np.pi * radius**2 / settings.fine_voxel**2  # points of a half sphere
            cell = min(0.4 * radius, _LARGEST_CELL)
            positions = (fine.points[rows] - radius * fine.normals[rows]) / cell
            centers, votes = crowded(positions, max(_SCORE * full, _FEWEST))
            candidates.append(np.column_stack([centers * cell, np.full(len(centers), radius)]))
            shares.append(votes / full)
        places = np.concatenate(candidates)
        found.append(places[peaks(places[:, :3], np.concatenate(shares), 1.1 * some[0])])
    return np.concatenate(found)


def _chosen(small: Small, confidence: Array, found: Credited, least: float, settings: ShapeSettings) -> list[int]:
    """Which spheres are credible, apart from others and mostly unexplained by them, the best first."""
    fits, points = small.fits, small.fine.points
    tree = cKDTree(points)
    explained = np.zeros(len(points), dtype=np.bool_)
    for fit in found.fits:
        explained[tree.query_ball_point(fit.center, fit.radius + settings.shell)] = True
    taken, chosen = list(found.fits), []
    for k in np.argsort(-confidence, kind="stable").tolist():
        if confidence[k] < least:
            break
        if all_apart(fits[k], taken) and explained[fits[k].points].mean() <= _EXPLAINED:
            explained[fits[k].points] = True
            taken.append(fits[k])
            chosen.append(k)
    return chosen
