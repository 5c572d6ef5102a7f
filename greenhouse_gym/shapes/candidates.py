"""What tells a fruit from a bent leaf: measures of fitted spheres, by shape, color and company.

A leaf that bends one way, or that goes on beyond the sphere, or passes through it, is none; nor is what is much larger
than the fruit of the row. Color is compared with the leaves of the same cloud only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.robust import quantiles
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import SphereFit, shell_of
from greenhouse_gym.shapes.surfaces import NO_LEAF, SurfaceCloud

MEASURES = (
    "coverage", "coverage^2", "log points", "rmse / mm", "alignment", "inside", "beyond", "crossing",
    "smaller bend", "larger bend", "log plane rmse / rmse", "filled", "contrast",
    "tone spread", "log radius", "patch's smaller bend", "patch's larger bend",
)  # fmt: skip
"""Names of what `measures` gives."""

COMPANY = ("larger", "smaller", "unlike neighbors", "neighbors", "gap / cm", "unlike tone")
"""Names of what `company` gives."""

MOST_CONTRAST = 0.5
"""Times 0.1 of redness: that fruit may be redder than leaves counts, not how much."""

_BEYOND = 0.010  # metres outside the shell: what goes on there is no part of a ball
_MOST_BEND = 2.5  # most bend that counts, as a multiple of the sphere's own


def measures(fits: Sequence[SphereFit], cloud: SurfaceCloud, settings: ShapeSettings) -> Array:
    """Measures (k, len(MEASURES)) of spheres by themselves, among all points of a cloud."""
    tree = cKDTree(cloud.points)
    rows = [_measures(fit, cloud, tree, settings) for fit in fits]
    return np.array(rows).reshape(-1, len(MEASURES))


def _measures(fit: SphereFit, cloud: SurfaceCloud, tree: cKDTree, settings: ShapeSettings) -> list[float]:
    shell = shell_of(fit.radius, settings)
    near = np.array(tree.query_ball_point(fit.center, fit.radius + shell + _BEYOND), dtype=np.int64)
    away = cloud.points[near] - fit.center
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    unit, residual = away / distance[:, None], distance - fit.radius
    cosine = (unit * cloud.normals[near]).sum(axis=1)
    skin = np.abs(residual) < shell
    on = skin & (cosine > 0.7)
    count = max(int(np.count_nonzero(on)), 1)
    inside, beyond, crossing = (
        float(np.log1p(int(np.count_nonzero(which)) / count))
        for which in (residual < -shell, residual > shell, skin & (cosine < 0.4))
    )
    if not on.any():
        on = skin
    own = away[on] - away[on].mean(axis=0)
    bends = (quantiles(cloud.bends[near[on]], 0.5) * fit.radius).clip(-1.0, _MOST_BEND)
    spread = np.linalg.eigvalsh(own.T @ own / (len(own) - 1)) if len(own) > 3 else np.ones(3)
    even = float(np.log((np.sqrt(max(spread[0], 0.0)) + 1e-4) / (fit.rmse + 1e-4)))
    middle = float(np.linalg.norm(unit[on].mean(axis=0)))  # 1 - |middle| of a cap is the share of the sphere it covers
    low, tone, high = quantiles(cloud.tones[near[on]], np.array([0.25, 0.5, 0.75]))
    contrast = float(np.clip((tone - cloud.leaf) / 0.1, -MOST_CONTRAST, MOST_CONTRAST)) if cloud.leaf > NO_LEAF else 0.0
    return [
        fit.coverage, fit.coverage**2, float(np.log(count)), 1e3 * fit.rmse, fit.alignment, inside, beyond, crossing,
        float(bends[0]), float(bends[1]), even, fit.coverage / (1.02 - middle), contrast,
        float(high - low) / 0.1, float(np.log(fit.radius / 0.025)), *_bends(unit[skin], cloud.normals[near[skin]]),
    ]  # fmt: skip


def _bends(outward: Array, normals: Array) -> list[float]:
    """How much the normals (k, 3) turn from one side of a patch to the other, both ways, less first; a ball's do by 1.

    Args:
        outward: (k, 3) unit vectors from the sphere's center to the points.
        normals: (k, 3) their normals.
    """
    if len(outward) < 4:
        return [0.0, 0.0]
    away, turned = outward - outward.mean(axis=0), normals - normals.mean(axis=0)
    across = np.linalg.eigh(away.T @ away)[1][:, 1:]  # the two directions in which the patch is widest
    along = away @ across
    place = along.T @ along + 1e-3 * len(away) * np.eye(2)
    slope = np.linalg.solve(place, along.T @ (turned @ across))
    return np.linalg.eigvalsh((slope + slope.T) / 2).clip(-1.0, _MOST_BEND).tolist()


def company(
    fits: Sequence[SphereFit],
    tones: Array,
    sure: Sequence[SphereFit],
    sure_tones: Array,
    settings: ShapeSettings,
) -> Array:
    """How spheres agree with those that are sure (k, len(COMPANY)): in size with the row and with those beside them.

    Args:
        fits: The spheres.
        tones: Redness (k,) of each.
        sure: Those that are tomatoes for sure.
        sure_tones: Redness (s,) of each of these.
        settings: All settings.
    """
    if not len(sure):
        return np.zeros((len(fits), len(COMPANY)))
    centers, radii = np.array([s.center for s in sure]), np.array([s.radius for s in sure])
    usual = float(np.median(radii))
    rows = []
    for fit, tone in zip(fits, tones.tolist(), strict=True):
        apart = np.linalg.norm(centers - fit.center, axis=1)
        gap = np.where(apart > 0.5 * radii, apart - radii - fit.radius, np.inf)  # not to itself
        beside = gap < settings.truss_gap
        size = float(np.log(fit.radius / usual))
        unlike = abs(float(np.log(fit.radius / np.median(radii[beside])))) if beside.any() else abs(size)
        nearest = int(gap.argmin())
        rows.append([
            max(size, 0.0), max(-size, 0.0), unlike, float(np.log1p(np.count_nonzero(beside))),
            float(np.clip(gap[nearest] / 0.01, 0.0, 5.0)),
            abs(float(tone - sure_tones[nearest])) / 0.1 if beside.any() else 0.0,
        ])  # fmt: skip
    return np.array(rows).reshape(-1, len(COMPANY))
