"""Large fruit: spheres fitted in two passes, scored by a classifier for each, and selected without overlap.

The first pass fits spheres of any size. The second searches around the first pass's confident fruit for spheres of
the same size and hue. Only a narrow piece of such a fruit shows, and its normals are distorted by its neighbors, so
neither its size nor the direction of its center can be estimated from it. So every point near a truss that is not yet
explained, and has its hue, votes for all centers at one radius behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.evidence import SHELL
from greenhouse_gym.shapes.fruit.sphere_features import (
    CONTEXT_FEATURES,
    MAX_CONTRAST,
    SPHERE_FEATURES,
    context_features,
    shell_features,
    sphere_features,
)
from greenhouse_gym.shapes.fruit.spheres import (
    SIZE_KNOWN,
    Bounds,
    SphereFit,
    dense_cells,
    even_directions,
    fit_spheres,
    is_separate,
    local_maxima,
    vote,
)
from greenhouse_gym.shapes.fruit.trusses import NEIGHBOR_GAP, group_neighbors
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud, fruit_mask

_VOTE_CELL = 1 / 3  # side of the vote's cells, in radii
_MIN_VOTERS = 7  # points that vote for one center
_HUE_TOLERANCE = 0.15  # redness by which a fruit may differ from those of its truss
_HIDDEN_OVERLAP = 0.15  # radii by which a sphere may reach into its neighbors

Classifier = Callable[[Array], Array]
"""Returns the confidence (k,), 0 to 1, that spheres with features (k, m) are fruit."""

SEED_WEIGHTS = np.array([
    12.54, -12.55, -1.977, 1.232, 55.67, -4.928, -2.524, 5.869, -1.454, -2.269, 5.039, 2.666, 9.603, 0.4137,
    0.8649, 2.43, 1.074, -55.88,
])  # fmt: skip
"""Logistic weights of `sphere_features.SPHERE_FEATURES`, and the offset."""

_CONFIDENT = 0.8  # confidence above which a fruit is context for others
_RMSE_UNIT = 0.001  # metres of root mean square distance that halve a sphere's rank
_MIN_OWN_POINTS = 0.6  # fraction of a sphere's points that better ones may not own
_LONE_CURVATURE = 0.2
"""Minimum smaller curvature, as a multiple of the sphere's, of a fruit without confident neighbors; stems have less.

The curvatures of a mostly hidden fruit are unreliable, so a confident fruit that is redder than leaves needs
neither this curvature nor `_LONE_PATCH_CURVATURE`.
"""
_LONE_PATCH_CURVATURE = 0.35  # the same for the curvature of the patch as a whole

_CONTRAST = SPHERE_FEATURES.index("contrast")
_SMALLER_CURVATURE = SPHERE_FEATURES.index("smaller curvature")
_PATCH_CURVATURE = SPHERE_FEATURES.index("patch's smaller curvature")
_NEIGHBORS = len(SPHERE_FEATURES) + CONTEXT_FEATURES.index("neighbors")


def fit_hidden(
    skin: SurfaceCloud, found: list[SphereFit], trusses: npt.NDArray[np.int32], radii: Bounds
) -> list[SphereFit]:
    """Fit spheres of the sizes of their trusses to points that the fruit found so far does not explain.

    Args:
        skin: The points that may be fruit.
        found: The fruit found so far, among ``skin``.
        trusses: (k,) truss number of each fruit.
        radii: Smallest and largest radius of tomatoes, metres.

    Returns:
        Spheres among ``skin``.
    """
    explained = np.zeros(len(skin), dtype=bool)
    tree = cKDTree(skin.points)
    for fit in found:
        explained[tree.query_ball_point(fit.center, fit.radius + SHELL)] = True
    left = np.flatnonzero(~explained)
    if not len(left):
        return []
    hue = np.array([np.median(skin.hues[fit.points]) for fit in found])
    points, normals, hues = skin.points[left], skin.normals[left], skin.hues[left]
    tree = cKDTree(points)
    candidates = [np.zeros((0, 4))]
    for truss in np.unique(trusses):
        own = np.flatnonzero(trusses == truss)
        centers = np.array([found[i].center for i in own])
        radius = float(np.median([found[i].radius for i in own]))
        balls = tree.query_ball_point(centers, 3 * radius + NEIGHBOR_GAP)
        near = np.unique(np.concatenate([np.array(ball, dtype=np.int64) for ball in balls]))
        alike = (hues[near] > hue[own].min() - _HUE_TOLERANCE) & (hues[near] < hue[own].max() + _HUE_TOLERANCE)
        candidates.append(_vote(points[near[alike]], normals[near[alike]], centers, radius))
    fits = fit_spheres(points, normals, np.concatenate(candidates), radii, SIZE_KNOWN)
    return [replace(fit, points=left[fit.points]) for fit in fits]


def _vote(points: Array, normals: Array, centers: Array, radius: float) -> Array:
    """Return candidates (k, 4) next to the fruits at ``centers`` that points (n, 3) vote for."""
    directions = even_directions(round(4 * np.pi / _VOTE_CELL**2))
    point, direction = np.nonzero(normals @ directions.T > 0)
    votes = points[point] - radius * directions[direction]
    gap = cKDTree(centers).query(votes)[0] - 2 * radius
    votes = votes[(gap > -_HIDDEN_OVERLAP * radius) & (gap < NEIGHBOR_GAP)]
    if not len(votes):
        return np.zeros((0, 4))
    cell = _VOTE_CELL * radius
    per_point = 9 * _VOTE_CELL**2 * len(directions) / (4 * np.pi)  # number of a point's votes near one center
    cells, count = dense_cells(votes / cell, _MIN_VOTERS * per_point)
    cells = cells[local_maxima(cells, count, 0.6 / _VOTE_CELL)] * cell
    return np.column_stack([cells, np.full(len(cells), radius)])


class SphereClassifiers(NamedTuple):
    """Classifiers of the spheres of the first and of the second pass."""

    first: Classifier
    second: Classifier


class ScoredFruit(NamedTuple):
    """Spheres (k,) found as tomatoes, with the confidence, 0 to 1, and the median hue of each."""

    fits: list[SphereFit]
    confidence: Array
    hues: Array


class Candidates(NamedTuple):
    """Spheres of both passes and their features.

    Attributes:
        skin: The points that may be fruit.
        first: Spheres of the first pass, among ``skin``.
        first_features: (k, m) features of these: of the spheres, their context and their shells.
        second: Spheres of the second pass, among ``skin``.
        second_features: (j, m) features of these.
    """

    skin: SurfaceCloud
    first: list[SphereFit]
    first_features: Array
    second: list[SphereFit]
    second_features: Array


def fit_candidates(cloud: SurfaceCloud, settings: ShapeSettings) -> Candidates:
    """Fit the spheres of both passes to a cloud and compute their features."""
    skin = cloud.select(fruit_mask(cloud))
    first = fit_spheres(skin.points, skin.normals, vote(skin.points, skin.normals, settings), settings.radii)
    own = sphere_features(first, cloud)
    confident = select_spheres(first, logistic(own, SEED_WEIGHTS), len(skin), _CONFIDENT)
    second = fit_hidden(skin, confident, group_neighbors(confident), settings.radii)

    def full_features(fits: list[SphereFit], own: Array) -> Array:
        context = context_features(fits, hues_of(fits, skin), confident, hues_of(confident, skin))
        return np.column_stack([own, context, shell_features(fits, cloud, settings.voxel)])

    second_features = full_features(second, sphere_features(second, cloud))
    return Candidates(skin, first, full_features(first, own), second, second_features)


def large_fruit(
    candidates: Candidates, settings: ShapeSettings, classifiers: SphereClassifiers | None = None
) -> ScoredFruit:
    """Score the candidates of both passes and select the tomatoes among them.

    Args:
        candidates: Spheres and their features.
        settings: All settings.
        classifiers: One for each pass; the shipped ones by default.
    """
    classifiers = classifiers or shipped_classifiers()
    features = candidates.first_features
    first, second = classifiers.first(features), classifiers.second(candidates.second_features)
    alone = features[:, _NEIGHBORS] == 0
    flat = features[:, _PATCH_CURVATURE] < _LONE_PATCH_CURVATURE
    flat |= features[:, _SMALLER_CURVATURE] < _LONE_CURVATURE
    red = (features[:, _CONTRAST] >= MAX_CONTRAST) & (first >= _CONFIDENT)
    scores = np.concatenate([np.where(alone & flat & ~red, 0.0, first), second])
    fits = [*candidates.first, *candidates.second]
    found = select_spheres(fits, scores, len(candidates.skin), settings.min_confidence)
    score_of = dict(zip(fits, scores.tolist(), strict=True))
    return ScoredFruit(found, np.array([score_of[fit] for fit in found]), hues_of(found, candidates.skin))


def select_spheres(fits: list[SphereFit], scores: Array, count: int, min_score: float) -> list[SphereFit]:
    """Select spheres greedily, each separate from better ones and with most of its points to itself.

    Scores say whether a sphere is fruit, and are nearly 1 for all spheres around one fruit, so these are ranked by how
    well they fit as well.

    Args:
        fits: Spheres among the same points.
        scores: (k,) of the spheres.
        count: Number of points.
        min_score: Minimum score.

    Returns:
        The selected spheres, ordered along the row.
    """
    owned = np.zeros(count, dtype=bool)
    chosen: list[SphereFit] = []
    rank = scores / (1.0 + np.array([fit.rmse for fit in fits]) / _RMSE_UNIT)
    for k in np.argsort(-rank, kind="stable").tolist():
        fit = fits[k]
        if scores[k] < min_score:
            continue
        if is_separate(fit, chosen) and np.count_nonzero(~owned[fit.points]) > _MIN_OWN_POINTS * len(fit.points):
            owned[fit.points] = True
            chosen.append(fit)
    return [chosen[k] for k in row_order(chosen)]


def row_order(fits: Sequence[SphereFit]) -> list[int]:
    """Return the indices of spheres from one end of the row to the other."""
    return sorted(range(len(fits)), key=lambda k: tuple(np.round(fits[k].center[[1, 2, 0]], 3)))


def hues_of(fits: Sequence[SphereFit], cloud: SurfaceCloud) -> Array:
    """Return the median hue (k,) of spheres among the points of a cloud."""
    return np.array([np.median(cloud.hues[fit.points]) for fit in fits])


def shipped_classifiers() -> SphereClassifiers:
    """Return the shipped networks.

    Their features are those of `sphere_features`, `context_features` and `shell_features`, in this order.
    """
    return SphereClassifiers(network("fruit/first_pass"), network("fruit/second_pass"))


def logistic(features: Array, weights: Array) -> Array:
    """Return probabilities (k,) from features (k, m) and their weights with the offset (m + 1,)."""
    return np.asarray(1 / (1 + np.exp(-np.clip(features @ weights[:-1] + weights[-1], -30.0, 30.0))))
