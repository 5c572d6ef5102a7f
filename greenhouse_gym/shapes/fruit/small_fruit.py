"""A third pass for small fruit in a finer cloud, since a few voxels of the coarse one hardly show any curvature.

Young fruit may be greener than leaves and as curved as their tips, so neither color nor curvature alone identifies it.
All points curved in at least one direction vote for spheres of small radii, and a network scores these. Confident ones
are context for the others, so a truss of young fruit is also scored as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.evidence import SHELL
from greenhouse_gym.shapes.fruit.large_fruit import Classifier, ScoredFruit, hues_of
from greenhouse_gym.shapes.fruit.sphere_features import context_features, shell_features, sphere_features
from greenhouse_gym.shapes.fruit.spheres import (
    ROUGHLY_KNOWN,
    SphereFit,
    dense_cells,
    fit_spheres,
    is_separate,
    local_maxima,
)
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud, colorful_mask

_RADII = 8  # radii tried, half of them in each octave
_CURVATURES = (35.0, 20.0)  # 1/m: larger curvature that a point needs to vote for the radii of each octave
_GREENER = 0.06  # points greener than the leaves by more, as (R - G) / (R + G), are no fruit
_MIN_SCORE, _MIN_VOTERS = 0.15, 6  # fraction of a half sphere's points, and number of points, that vote for a center
_MAX_CELL = 0.004  # metres: side of the cells in which votes are counted
_CONFIDENT = 0.7  # confidence above which small fruit is context for others
_CLEAR = 0.8  # confidence of larger fruit that shows that a cloud without leaves is of a plant
_MAX_EXPLAINED = 0.4  # fraction of a sphere's points that other fruit may explain


class SmallSpheres(NamedTuple):
    """Small spheres (k,) in a fine cloud, their own features (k, m) without context, and their hues (k,)."""

    fine: SurfaceCloud
    fits: list[SphereFit]
    features: Array
    hues: Array

    def with_context(self, found: ScoredFruit, chosen: Sequence[int]) -> Array:
        """Return the features (k, m) with the context of fruit found before and of chosen small spheres."""
        confident = [*found.fits, *(self.fits[k] for k in chosen)]
        hues = np.concatenate([found.hues, self.hues[list(chosen)]])
        return np.column_stack([self.features, context_features(self.fits, self.hues, confident, hues)])


def find_small(
    fine: SurfaceCloud, found: ScoredFruit, settings: ShapeSettings, classifier: Classifier | None = None
) -> ScoredFruit:
    """Find small fruit next to the fruit found before; none where the cloud shows neither leaves nor clear fruit.

    Args:
        fine: A cloud with a point per voxel of ``settings.fine_voxel``.
        found: The tomatoes found before.
        settings: All settings.
        classifier: Scores spheres by their features; the shipped network by default.

    Returns:
        Spheres among the points of ``fine``.
    """
    is_table = fine.leaf_hue == NO_LEAF and not (found.confidence >= _CLEAR).any()  # small round things lie on it
    if is_table or settings.small_radii is None or not len(fine):
        return ScoredFruit([], np.zeros(0), np.zeros(0))
    return select_small(small_spheres(fine, settings), found, settings, classifier or network("fruit/small_fruit"))


def select_small(
    small: SmallSpheres, found: ScoredFruit, settings: ShapeSettings, classifier: Classifier
) -> ScoredFruit:
    """Select the small spheres that are fruit."""
    confidence = classifier(small.with_context(found, confident_small(small, found, classifier)))
    chosen = _select(small, confidence, found, settings.min_confidence)
    return ScoredFruit([small.fits[k] for k in chosen], confidence[chosen], small.hues[chosen])


def confident_small(small: SmallSpheres, found: ScoredFruit, classifier: Classifier) -> list[int]:
    """Return the indices of the small spheres that are fruit even without others as context."""
    return _select(small, classifier(small.with_context(found, [])), found, _CONFIDENT)


def small_spheres(fine: SurfaceCloud, settings: ShapeSettings) -> SmallSpheres:
    """Fit all small spheres in a fine cloud."""
    assert settings.small_radii is not None
    low, high = settings.small_radii
    candidates = _vote(fine, np.geomspace(low, high, _RADII), settings.fine_voxel)
    fits = fit_spheres(fine.points, fine.normals, candidates, (0.8 * low, 1.2 * high), ROUGHLY_KNOWN)
    features = np.column_stack([sphere_features(fits, fine), shell_features(fits, fine, settings.fine_voxel)])
    return SmallSpheres(fine, fits, features, hues_of(fits, fine))


def _vote(fine: SurfaceCloud, radii: Array, spacing: float) -> Array:
    """Return candidate spheres (k, 4) of radii (r,), metres, at the peaks of the votes of each octave."""
    able = colorful_mask(fine.colors) & (fine.hues > fine.leaf_hue - _GREENER)
    found = []
    for octave, curvature in zip(np.split(radii, len(_CURVATURES)), _CURVATURES, strict=True):
        rows = np.flatnonzero(able & (fine.curvatures[:, 1] > curvature))
        candidates, scores = [np.zeros((0, 4))], [np.zeros(0)]
        for radius in octave if len(rows) else ():
            half = 2 * np.pi * radius**2 / spacing**2  # points of a half sphere
            cell = min(0.4 * radius, _MAX_CELL)
            positions = (fine.points[rows] - radius * fine.normals[rows]) / cell
            centers, votes = dense_cells(positions, max(_MIN_SCORE * half, _MIN_VOTERS))
            candidates.append(np.column_stack([centers * cell, np.full(len(centers), radius)]))
            scores.append(votes / half)
        spheres = np.concatenate(candidates)
        found.append(spheres[local_maxima(spheres[:, :3], np.concatenate(scores), 1.1 * octave[0])])
    return np.concatenate(found)


def _select(small: SmallSpheres, confidence: Array, found: ScoredFruit, min_confidence: float) -> list[int]:
    """Return the spheres selected greedily by confidence, separate from others and mostly unexplained by them."""
    fits, points = small.fits, small.fine.points
    tree = cKDTree(points)
    explained = np.zeros(len(points), dtype=np.bool_)
    for fit in found.fits:
        explained[tree.query_ball_point(fit.center, fit.radius + SHELL)] = True
    taken, chosen = list(found.fits), []
    for k in np.argsort(-confidence, kind="stable").tolist():
        if confidence[k] < min_confidence:
            break
        if is_separate(fits[k], taken) and explained[fits[k].points].mean() <= _MAX_EXPLAINED:
            explained[fits[k].points] = True
            taken.append(fits[k])
            chosen.append(k)
    return chosen
