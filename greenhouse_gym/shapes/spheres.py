"""Spheres in a cloud: oriented points vote for centers, robust least squares refines them.

Every surface point of a sphere votes for the same center, ``point - radius * normal``, so centers are peaks of a
histogram over positions and radii (a Hough transform for spheres with oriented points). Radii of one octave compete
with each other; which of the overlapping spheres of different octaves is right is decided later, by their fit.
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
from greenhouse_gym.shapes.robust import SCALES, gauss_newton_step, tukey_weights
from greenhouse_gym.shapes.settings import ShapeSettings

_ABOVE_PLANE = 1.2  # a sphere has so many times the votes that a plane gathers in one place
_MOST_POINTS = 300  # most points that a fit looks at
_TOGETHER = 256  # candidates that are refined at once
APART = 0.75  # sums of two radii by which spheres that are beside each other are apart
_DIRECTIONS = 100  # directions in which a sphere's coverage is counted


class Trust(NamedTuple):
    """What a fit may rely on.

    Attributes:
        aligned: Least cosine between the normals of the points that count and the sphere's, iteration by iteration.
        on: That least cosine for points of the final sphere.
        radius: Share of the points' weight with which the candidate's radius holds.
        fewest: Points that make a sphere.
    """

    aligned: tuple[float, ...]
    on: float
    radius: float
    fewest: int


IN_NORMALS = Trust((0.7, 0.7, 0.7, 0.7, 0.7, 0.7, 0.85, 0.85), on=0.7, radius=1e-5, fewest=10)
"""The normals are right, the size is unknown."""

IN_SIZE = Trust((-0.2,) * len(SCALES), on=-1.0, radius=1e3, fewest=8)
"""The size is known, the normals may be wrong."""

IN_SHAPE = Trust((0.0,) * len(SCALES), on=0.2, radius=0.1, fewest=10)
"""The size is roughly known, and so are the normals."""


@dataclass(frozen=True, eq=False)
class SphereFit(Sphere):
    """A sphere found in a cloud.

    Attributes:
        points: Rows of the cloud that lie on it.
        coverage: Share of its directions in which it was seen.
        rmse: Root mean square distance of its points from it, metres.
        alignment: Mean cosine between their normals and its own.
    """

    points: npt.NDArray[np.int64]
    coverage: float
    rmse: float
    alignment: float


def vote(points: Array, normals: Array, settings: ShapeSettings) -> Array:
    """Candidate spheres (k, 4), center and radius, at the peaks of the vote."""
    if not len(points):
        return np.zeros((0, 4))
    octaves = max(1, round(np.log2(settings.radii[1] / settings.radii[0])))
    edges = np.geomspace(settings.radii[0], settings.radii[1] + settings.radius_step, octaves + 1)
    return np.concatenate(
        [
            _of_octave(points, normals, np.arange(low, high - 1e-9, min(settings.radius_step, low / 4)), settings)
            for low, high in pairwise(edges)
        ]
    )


def _of_octave(points: Array, normals: Array, radii: Array, settings: ShapeSettings) -> Array:
    """Candidates (k, 4) of one octave: what nothing near has more votes than."""
    cell = min(settings.vote_cell, 0.4 * float(radii[0]))
    score = settings.min_score if radii[0] >= 2 * settings.radii[0] else settings.min_score_small
    candidates, shares = [np.zeros((0, 4))], [np.zeros(0)]
    for radius in radii:
        half = 2 * np.pi * radius**2  # square metres
        # a plane's votes fall into one layer of cells
        least = max(score, _ABOVE_PLANE * (3 * cell) ** 2 / half)
        centers, votes = crowded((points - radius * normals) / cell, least * half / settings.voxel**2)
        candidates.append(np.column_stack([centers * cell, np.full(len(centers), radius)]))
        shares.append(votes * settings.voxel**2 / half)
    found, share = np.concatenate(candidates), np.concatenate(shares)
    return found[peaks(found[:, :3], share, max(1.8 * cell, 0.6 * radii[0]))]


def peaks(positions: Array, votes: Array, reach: float) -> npt.NDArray[np.bool_]:
    """Which of the positions (n, 3) nothing within reach has more votes (n,) than."""
    pairs = cKDTree(positions).query_pairs(reach, output_type="ndarray")
    beaten = np.zeros(len(positions), dtype=bool)
    beaten[np.where(votes[pairs[:, 0]] < votes[pairs[:, 1]], pairs[:, 0], pairs[:, 1])] = True
    return ~beaten


def crowded(positions: Array, least: float) -> tuple[Array, Array]:
    """Centers (k, 3) of the unit cells in whose neighborhood of 27 at least so many positions (n, 3) lie, and how many.

    Only cells that hold their share of the neighborhood themselves are looked at.
    """
    cells = np.floor(positions).astype(np.int64)
    low = cells.min(axis=0) - 1
    span = cells.max(axis=0) + 2 - low
    keys, counts = np.unique(np.ravel_multi_index(tuple((cells - low).T), tuple(span)), return_counts=True)
    before = np.concatenate([[0], np.cumsum(counts)])  # votes in the cells ahead of each
    full = keys[counts >= least / 27]
    votes = np.zeros(len(full), dtype=np.int64)
    for x in (-1, 0, 1):
        for y in (-1, 0, 1):  # the three cells along the last axis have consecutive keys
            row = full + (x * span[1] + y) * span[2]
            votes += before[np.searchsorted(keys, row + 1, "right")] - before[np.searchsorted(keys, row - 1, "left")]
    crowded = votes >= least
    centers = np.stack(np.unravel_index(full[crowded], tuple(span)), axis=1) + low + 0.5
    return centers, votes[crowded].astype(np.float64)


def shell_of(radii: npt.ArrayLike, settings: ShapeSettings) -> Array:
    """How near to spheres their points lie, metres: nearer to smaller ones."""
    return np.minimum(settings.shell, 0.3 * np.asarray(radii))


def fit_spheres(
    points: Array, normals: Array, candidates: Array, settings: ShapeSettings, trust: Trust = IN_NORMALS
) -> list[SphereFit]:
    """Refine candidates (k, 4); those that fit nothing are left out."""
    tree = cKDTree(points)
    directions = even_directions(_DIRECTIONS)
    fits = []
    for refined in _refined(points, normals, candidates, tree, settings, trust):
        near = np.array(tree.query_ball_point(refined[:3], 1.3 * refined[3]), dtype=np.int64)
        fit = _assess(points, normals, near, refined[:3], float(refined[3]), directions, settings, trust)
        if fit is not None:
            fits.append(fit)
    return fits


def _refined(
    points: Array, normals: Array, candidates: Array, tree: cKDTree, settings: ShapeSettings, trust: Trust
) -> Array:
    """The candidates (k, 4) that fit something, refined, (j, 4).

    Those with about as many points are refined together.
    """
    spheres = np.full(candidates.shape, np.nan)
    order = np.argsort(tree.query_ball_point(candidates[:, :3], 1.4 * candidates[:, 3], return_length=True))
    for some in np.split(order, range(_TOGETHER, len(order), _TOGETHER)):
        near = tree.query_ball_point(candidates[some, :3], 1.4 * candidates[some, 3])
        thinner = [rows[:: max(1, len(rows) // _MOST_POINTS)] for rows in near]
        filled = np.zeros((len(some), max(map(len, thinner), default=0)), dtype=np.int64)
        real = np.zeros(filled.shape, dtype=np.bool_)
        for k, rows in enumerate(thinner):
            filled[k, : len(rows)], real[k, : len(rows)] = rows, True
        spheres[some] = _refine(points[filled], normals[filled], real, candidates[some], settings, trust)
    return spheres[np.isfinite(spheres[:, 3])]


def _refine(
    points: Array,
    normals: Array,
    real: npt.NDArray[np.bool_],
    candidates: Array,
    settings: ShapeSettings,
    trust: Trust,
) -> Array:
    """Gauss-Newton with Tukey weights on ``distance - radius``; points whose normals look away do not count.

    Args:
        points: (k, n, 3) near each candidate.
        normals: (k, n, 3) of them.
        real: (k, n) which are points; others fill up.
        candidates: (k, 4) centers and radii.
        settings: All settings.
        trust: What the fits may rely on.

    Returns:
        (k, 4) centers and radii; NaN where nothing fits.
    """
    refined = candidates.copy()
    shells = shell_of(candidates[:, 3], settings)
    fitting = np.arange(len(candidates))  # rows of the candidates that still fit something
    for scale, aligned in zip(SCALES, trust.aligned, strict=True):
        away = points - refined[fitting, None, :3]
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-9)
        unit = away / distance[:, :, None]
        residual = distance - refined[fitting, None, 3]
        weight = tukey_weights(residual, scale * shells[fitting, None])
        weight *= real & ((unit * normals).sum(axis=2) > aligned)
        enough = np.count_nonzero(weight, axis=1) >= trust.fewest
        jacobian = np.concatenate([-unit, np.full((*unit.shape[:2], 1), -1.0)], axis=2)[enough]
        damping = np.array([1e-3, 1e-3, 1e-3, trust.radius])
        refined[fitting[enough]] += gauss_newton_step(jacobian, weight[enough], residual[enough], damping)
        radii = refined[fitting, 3]
        kept = enough & (radii >= settings.radii[0] * 0.9) & (radii <= settings.radii[1] * 1.1)
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
    settings: ShapeSettings,
    trust: Trust,
) -> SphereFit | None:
    away = points[near] - center
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    unit, residual = away / distance[:, None], distance - radius
    alignment = (unit * normals[near]).sum(axis=1)
    on = (np.abs(residual) < shell_of(radius, settings)) & (alignment > trust.on)
    if np.count_nonzero(on) < trust.fewest:
        return None
    return SphereFit(
        center,
        radius,
        near[on],
        coverage=len(np.unique((unit[on] @ directions.T).argmax(axis=1))) / len(directions),
        rmse=float(np.sqrt(np.mean(residual[on] ** 2))),
        alignment=float(alignment[on].mean()),
    )


def all_apart(fit: Sphere, others: Sequence[Sphere]) -> bool:
    """Whether a sphere is beside all others, and not in one of their places."""
    centers, radii = np.array([o.center for o in others]).reshape(-1, 3), np.array([o.radius for o in others])
    return bool((np.linalg.norm(centers - fit.center, axis=1) > APART * (radii + fit.radius)).all())


def even_directions(count: int) -> Array:
    """Unit vectors (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
