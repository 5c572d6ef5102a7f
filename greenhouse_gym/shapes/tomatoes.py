"""Tomatoes: spheres by voting of ``point - radius * normal``, refined by robust least squares.

Every surface point of a sphere votes for the same center, so centers are peaks of a histogram over positions and
radii (a Hough transform for spheres with oriented points).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.crop import Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.settings import ShapeSettings

_REDNESS = np.array([-0.12, 0.07, 0.34, 0.77])
"""(R - G) / (R + G) of the skin at ripeness 0, 1/3, 2/3, 1: green, turning, orange, red."""

_MOST_CELLS = 1e8  # of one histogram; 400 MB


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere found in a cloud.

    Attributes:
        center: (3,) metres.
        radius: Metres.
        points: Rows of the cloud that lie on it.
        coverage: Share of its directions in which it was seen.
    """

    center: Array
    radius: float
    points: npt.NDArray[np.int64]
    coverage: float


def find_tomatoes(points: Array, normals: Array, colors: Array, settings: ShapeSettings) -> tuple[Tomato, ...]:
    """Find tomatoes in a cloud.

    Args:
        points: (n, 3) metres, one per voxel of ``settings.voxel``.
        normals: (n, 3) unit vectors pointing out of the surfaces.
        colors: (n, 3) RGB in [0, 1].
        settings: All settings.

    Returns:
        Spheres with truss numbers and ripeness.
    """
    fits = choose(fit_candidates(points, normals, vote(points, normals, settings), settings), points, settings)
    if not fits:
        return ()
    centers, radii = np.array([f.center for f in fits]), np.array([f.radius for f in fits])
    trusses = group_trusses(centers, radii, settings.truss_gap)
    return tuple(
        Tomato(f.center, f.radius, truss=int(truss), ripeness=ripeness_of(colors[f.points]))
        for f, truss in zip(fits, trusses, strict=True)
    )


def vote(points: Array, normals: Array, settings: ShapeSettings) -> Array:
    """Candidate spheres (k, 4), center and radius, at the peaks of the vote.

    A cloud too large for one histogram is cut in two across its longest axis, and each half votes with what is near.
    """
    if not len(points):
        return np.zeros((0, 4))
    extent = np.ptp(points, axis=0) + 2 * settings.radii[1]
    if np.prod(extent / settings.vote_cell) > _MOST_CELLS:
        axis = int(np.argmax(extent))
        low, high = points[:, axis].min(), points[:, axis].max()
        middle, reach = (low + high) / 2, 2 * settings.radii[1]
        parts = []
        for near, own in ((points[:, axis] < middle + reach, -1), (points[:, axis] > middle - reach, 1)):
            found = vote(points[near], normals[near], settings)
            parts.append(found[np.where(found[:, axis] < middle, -1, 1) == own])
        return np.concatenate(parts)
    cell = settings.vote_cell
    low = points.min(axis=0) - settings.radii[1] - 2 * cell
    shape = np.ceil((points.max(axis=0) + settings.radii[1] + 2 * cell - low) / cell).astype(int) + 1
    radii = np.arange(settings.radii[0], settings.radii[1] + 1e-9, settings.radius_step)
    best = np.zeros(shape, dtype=np.float32)
    best_radius = np.zeros(shape, dtype=np.float32)
    for radius in radii:
        cells = ((points - radius * normals - low) / cell).astype(np.int64)
        flat = np.ravel_multi_index(tuple(cells.T), tuple(shape))
        votes = np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape).astype(np.float32)
        share = ndimage.uniform_filter(votes, 3) * (27.0 * settings.voxel**2 / (2 * np.pi * radius**2))
        better = share > best
        best[better], best_radius[better] = share[better], radius
    window = 2 * round(0.6 * settings.radii[0] / cell) + 1
    peaks = np.argwhere((best == ndimage.maximum_filter(best, window)) & (best > settings.min_score))
    strength = best[tuple(peaks.T)]
    order = np.argsort(-strength, kind="stable")
    return np.column_stack([low + (peaks[order] + 0.5) * cell, best_radius[tuple(peaks[order].T)]])


def fit_candidates(points: Array, normals: Array, candidates: Array, settings: ShapeSettings) -> list[SphereFit]:
    """Refine candidates (k, 4) and keep those that look like a fruit."""
    tree = cKDTree(points)
    directions = _even_directions(100)
    fits = []
    for candidate in candidates:
        center, radius = candidate[:3], float(candidate[3])
        near = np.array(tree.query_ball_point(center, 1.4 * radius), dtype=np.int64)
        fit = _fit_sphere(points, normals, near, center, radius, directions, settings)
        if fit is not None:
            fits.append(fit)
    return fits


def _fit_sphere(
    points: Array,
    normals: Array,
    near: npt.NDArray[np.int64],
    center: Array,
    radius: float,
    directions: Array,
    settings: ShapeSettings,
) -> SphereFit | None:
    """Gauss-Newton with Tukey weights on ``distance - radius``; points whose normals look away do not count."""
    if len(near) < 20:
        return None
    cloud, looking = points[near], normals[near]
    for scale in (3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.0, 1.0):
        away = cloud - center
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        unit = away / distance[:, None]
        residual = distance - radius
        weight = np.clip(1 - (residual / (scale * settings.shell)) ** 2, 0, None) ** 2
        weight *= (unit * looking).sum(axis=1) > 0.7
        if np.count_nonzero(weight) < 20:
            return None
        jacobian = np.column_stack([-unit, -np.ones(len(unit))])
        normal_matrix = jacobian.T @ (weight[:, None] * jacobian) + 1e-3 * weight.sum() * np.diag([1, 1, 1, 1e-2])
        step = np.linalg.solve(normal_matrix, -jacobian.T @ (weight * residual))
        center, radius = center + step[:3], radius + float(step[3])
        if not settings.radii[0] * 0.85 <= radius <= settings.radii[1] * 1.15:
            return None
    away = cloud - center
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    unit, residual = away / distance[:, None], distance - radius
    alignment = (unit * looking).sum(axis=1)
    on = (np.abs(residual) < settings.shell) & (alignment > 0.7)
    count = np.count_nonzero(on)
    if count < 20 or np.sqrt(np.mean(residual[on] ** 2)) > settings.max_residual:
        return None
    outside = np.count_nonzero((residual > settings.shell) & (residual < 0.3 * radius))
    if alignment[on].mean() < settings.min_alignment or outside > settings.max_outside * count:
        return None
    seen = np.bincount((unit[on] @ directions.T).argmax(axis=1), minlength=len(directions)) > 0
    if seen.mean() < settings.min_coverage:
        return None
    return SphereFit(center, radius, near[on], float(seen.mean()))


def choose(fits: list[SphereFit], points: Array, settings: ShapeSettings) -> list[SphereFit]:
    """Drop fits that explain what a better one explains: best first, each must own most of its points."""
    owner = np.zeros(len(points), dtype=bool)
    chosen: list[SphereFit] = []
    for fit in sorted(fits, key=lambda f: -f.coverage * f.radius):
        own = fit.points[~owner[fit.points]]
        apart = all(np.linalg.norm(fit.center - other.center) > 0.75 * (fit.radius + other.radius) for other in chosen)
        if apart and len(own) > 0.6 * len(fit.points):
            owner[fit.points] = True
            chosen.append(fit)
    return sorted(chosen, key=lambda f: tuple(np.round(f.center[[1, 2, 0]], 3)))


def group_trusses(centers: Array, radii: Array, gap: float) -> npt.NDArray[np.int32]:
    """Truss number (n,) of each fruit: fruits whose skins are less than ``gap`` metres apart hang together."""
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1) - radii[:, None] - radii[None]
    links = coo_array(distance < gap)
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int32)


def ripeness_of(colors: Array) -> float:
    """Ripeness, 0 to 1, from the skin's colors (n, 3): by the median of (R - G) / (R + G), which ignores shading."""
    red, green = colors[:, 0], colors[:, 1]
    redness = np.median((red - green) / np.maximum(red + green, 1e-6))
    return float(np.round(np.interp(redness, _REDNESS, np.linspace(0, 1, len(_REDNESS))), 3))


def _even_directions(count: int) -> Array:
    """Unit vectors (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
