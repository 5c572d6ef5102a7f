"""Spheres in a cloud: oriented points vote for centers, robust least squares refines them.

Every surface point of a sphere votes for the same center, ``point - radius * normal``, so centers are peaks of a
histogram over positions and radii (a Hough transform for spheres with oriented points). Radii of one octave compete
with each other; overlapping spheres of different octaves are resolved later, by their fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.evidence import SHELL
from greenhouse_gym.shapes.robust_fit import SCALES, gauss_newton_step, tukey_weights
from greenhouse_gym.shapes.settings import ShapeSettings

_RADIUS_STEP = 0.003  # metres between the radii of one octave, at most
_MAX_CELL = 0.005  # metres: side of the cells in which votes are counted
_MIN_SCORE = 0.12  # fraction of a half sphere's points that must vote for its center
_MIN_SCORE_SMALL = 0.25  # the same for the smallest radii, for which leaves give many votes
_ABOVE_PLANE = 1.2  # minimum votes as a multiple of those that a plane gives one cell
_MAX_POINTS = 300  # points used by one fit
_BATCH = 256  # candidates refined together
_MIN_SEPARATION = 0.75  # of the sum of two radii: spheres with nearer centers are one fruit
_DIRECTIONS = 100  # directions in which a sphere's coverage is counted

Bounds = tuple[float, float]


class FitPrior(NamedTuple):
    """Assumptions of a fit.

    Attributes:
        alignment: Minimum cosine between the normals of the points used and the sphere's, per iteration.
        final_alignment: The same for points of the final sphere.
        radius_damping: Damping of the radius towards the candidate's, as a fraction of the points' weight.
        min_points: Points that make a sphere.
    """

    alignment: tuple[float, ...]
    final_alignment: float
    radius_damping: float
    min_points: int


NORMALS_KNOWN = FitPrior((0.7, 0.7, 0.7, 0.7, 0.7, 0.7, 0.85, 0.85), 0.7, radius_damping=1e-5, min_points=10)
"""The normals are reliable, the size is unknown."""

SIZE_KNOWN = FitPrior((-0.2,) * len(SCALES), -1.0, radius_damping=1e3, min_points=8)
"""The size is known, the normals may be wrong."""

ROUGHLY_KNOWN = FitPrior((0.0,) * len(SCALES), 0.2, radius_damping=0.1, min_points=10)
"""Size and normals are roughly known."""


@dataclass(frozen=True, eq=False)
class SphereFit(Sphere):
    """A sphere found in a cloud.

    Attributes:
        points: Rows of the cloud that lie on it.
        coverage: Fraction of its directions in which it was seen.
        rmse: Root mean square distance of its points from it, metres.
        alignment: Mean cosine between their normals and its own.
    """

    points: npt.NDArray[np.int64]
    coverage: float
    rmse: float
    alignment: float


def vote(points: Array, normals: Array, settings: ShapeSettings) -> Array:
    """Return candidate spheres (k, 4), center and radius, at the peaks of the vote."""
    if not len(points):
        return np.zeros((0, 4))
    low, high = settings.radii
    octaves = max(1, round(np.log2(high / low)))
    edges = np.geomspace(low, high + _RADIUS_STEP, octaves + 1)
    return np.concatenate(
        [
            _vote_in_octave(points, normals, np.arange(start, end - 1e-9, min(_RADIUS_STEP, start / 4)), settings)
            for start, end in pairwise(edges)
        ]
    )


def _vote_in_octave(points: Array, normals: Array, radii: Array, settings: ShapeSettings) -> Array:
    """Return the candidates (k, 4) of one octave: local maxima of the votes."""
    cell = min(_MAX_CELL, 0.4 * float(radii[0]))
    min_score = _MIN_SCORE if radii[0] >= 2 * settings.radii[0] else _MIN_SCORE_SMALL
    candidates, scores = [np.zeros((0, 4))], [np.zeros(0)]
    for radius in radii:
        half = 2 * np.pi * radius**2  # square metres
        # a plane's votes fall into one layer of cells
        score = max(min_score, _ABOVE_PLANE * (3 * cell) ** 2 / half)
        centers, votes = dense_cells((points - radius * normals) / cell, score * half / settings.voxel**2)
        candidates.append(np.column_stack([centers * cell, np.full(len(centers), radius)]))
        scores.append(votes * settings.voxel**2 / half)
    found, score = np.concatenate(candidates), np.concatenate(scores)
    return found[local_maxima(found[:, :3], score, max(1.8 * cell, 0.6 * radii[0]))]


def local_maxima(positions: Array, votes: Array, reach: float) -> npt.NDArray[np.bool_]:
    """Return which positions (n, 3) have at least the votes (n,) of all others within reach."""
    pairs = cKDTree(positions).query_pairs(reach, output_type="ndarray")
    beaten = np.zeros(len(positions), dtype=bool)
    beaten[np.where(votes[pairs[:, 0]] < votes[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
    return ~beaten


def dense_cells(positions: Array, min_votes: float) -> tuple[Array, Array]:
    """Return the unit cells with ``min_votes`` positions in their 27-neighborhoods: centers (k, 3) and counts (k,).

    Only cells that hold a 27th of ``min_votes`` themselves are considered.
    """
    cells = np.floor(positions).astype(np.int64)
    low = cells.min(axis=0) - 1
    span = cells.max(axis=0) + 2 - low
    keys, counts = np.unique(np.ravel_multi_index(tuple((cells - low).T), tuple(span)), return_counts=True)
    before = np.concatenate([[0], np.cumsum(counts)])  # votes in the cells ahead of each
    full = keys[counts >= min_votes / 27]
    votes = np.zeros(len(full), dtype=np.int64)
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):  # the three cells along the last axis have consecutive keys
            row = full + (x * span[1] + y) * span[2]
            votes += before[np.searchsorted(keys, row + 1, "right")] - before[np.searchsorted(keys, row - 1, "left")]
    dense = votes >= min_votes
    centers = np.stack(np.unravel_index(full[dense], tuple(span)), axis=1) + low + 0.5
    return centers, votes[dense].astype(np.float64)


def shell_of(radii: npt.ArrayLike) -> Array:
    """Return the largest distance of points from spheres they belong to, metres: smaller for small spheres."""
    return np.minimum(SHELL, 0.3 * np.asarray(radii))


def fit_spheres(
    points: Array, normals: Array, candidates: Array, radii: Bounds, prior: FitPrior = NORMALS_KNOWN
) -> list[SphereFit]:
    """Refine candidates (k, 4) and drop those that do not fit.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        candidates: (k, 4) centers and radii.
        radii: Smallest and largest radius, metres; fits may exceed them by a tenth.
        prior: Assumptions of the fits.
    """
    tree = cKDTree(points)
    directions = even_directions(_DIRECTIONS)
    fits = []
    for refined in _refine_in_batches(points, normals, candidates, tree, radii, prior):
        near = np.array(tree.query_ball_point(refined[:3], 1.3 * refined[3]), dtype=np.int64)
        fit = _assess(points, normals, near, refined[:3], float(refined[3]), directions, prior)
        if fit is not None:
            fits.append(fit)
    return fits


def _refine_in_batches(
    points: Array, normals: Array, candidates: Array, tree: cKDTree, radii: Bounds, prior: FitPrior
) -> Array:
    """Return the refined candidates (j, 4) that fit; those with similar numbers of points are refined together."""
    spheres = np.full(candidates.shape, np.nan)
    order = np.argsort(tree.query_ball_point(candidates[:, :3], 1.4 * candidates[:, 3], return_length=True))
    for batch in np.split(order, range(_BATCH, len(order), _BATCH)):
        near = tree.query_ball_point(candidates[batch, :3], 1.4 * candidates[batch, 3])
        thinned = [rows[:: max(1, len(rows) // _MAX_POINTS)] for rows in near]
        filled = np.zeros((len(batch), max(map(len, thinned), default=0)), dtype=np.int64)
        real = np.zeros(filled.shape, dtype=np.bool_)
        for k, rows in enumerate(thinned):
            filled[k, : len(rows)], real[k, : len(rows)] = rows, True
        spheres[batch] = _refine(points[filled], normals[filled], real, candidates[batch], radii, prior)
    return spheres[np.isfinite(spheres[:, 3])]


def _refine(
    points: Array, normals: Array, real: npt.NDArray[np.bool_], candidates: Array, radii: Bounds, prior: FitPrior
) -> Array:
    """Refine spheres by Gauss-Newton with Tukey weights on ``distance - radius``.

    Args:
        points: (k, n, 3) near each candidate.
        normals: (k, n, 3) of the points; those that face away from the sphere's get no weight.
        real: (k, n) False for padding.
        candidates: (k, 4) centers and radii.
        radii: Smallest and largest radius, metres.
        prior: Assumptions of the fits.

    Returns:
        (k, 4) centers and radii; NaN where nothing fits.
    """
    refined = candidates.copy()
    shells = shell_of(candidates[:, 3])
    fitting = np.arange(len(candidates))  # rows of the candidates that still fit
    for scale, alignment in zip(SCALES, prior.alignment, strict=True):
        offset = points - refined[fitting, None, :3]
        distance = np.maximum(np.linalg.norm(offset, axis=2), 1e-9)
        unit = offset / distance[:, :, None]
        residual = distance - refined[fitting, None, 3]
        weight = tukey_weights(residual, scale * shells[fitting, None])
        weight *= real & ((unit * normals).sum(axis=2) > alignment)
        enough = np.count_nonzero(weight, axis=1) >= prior.min_points
        jacobian = np.concatenate([-unit, np.full((*unit.shape[:2], 1), -1.0)], axis=2)[enough]
        damping = np.array([1e-3, 1e-3, 1e-3, prior.radius_damping])
        refined[fitting[enough]] += gauss_newton_step(jacobian, weight[enough], residual[enough], damping)
        size = refined[fitting, 3]
        kept = enough & (size >= radii[0] * 0.9) & (size <= radii[1] * 1.1)
        refined[fitting[~kept]] = np.nan
        points, normals, real, fitting = points[kept], normals[kept], real[kept], fitting[kept]
    return refined


def _assess(
    points: Array,
    normals: Array,
    near: npt.NDArray[np.int64],
    center: Array,
    radius: float,
    directions: Array,
    prior: FitPrior,
) -> SphereFit | None:
    offset = points[near] - center
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    unit, residual = offset / distance[:, None], distance - radius
    alignment = (unit * normals[near]).sum(axis=1)
    on = (np.abs(residual) < shell_of(radius)) & (alignment > prior.final_alignment)
    if np.count_nonzero(on) < prior.min_points:
        return None
    return SphereFit(
        center,
        radius,
        near[on],
        coverage=len(np.unique((unit[on] @ directions.T).argmax(axis=1))) / len(directions),
        rmse=float(np.sqrt(np.mean(residual[on] ** 2))),
        alignment=float(alignment[on].mean()),
    )


def is_separate(sphere: Sphere, others: Sequence[Sphere]) -> bool:
    """Return whether a sphere is far enough from all others to be another fruit."""
    centers, radii = np.array([o.center for o in others]).reshape(-1, 3), np.array([o.radius for o in others])
    return bool((np.linalg.norm(centers - sphere.center, axis=1) > _MIN_SEPARATION * (radii + sphere.radius)).all())


def even_directions(count: int) -> Array:
    """Return unit vectors (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
