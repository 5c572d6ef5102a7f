"""Features of spheres that distinguish fruit from curved leaves: of the sphere itself, of shells around it, of its row.

A leaf that curves in one direction only, or that continues outside of the sphere or through it, is no fruit. Color is
compared with the leaves of the same cloud only. The tip of a leaf is curved like a small fruit, but its surface
continues through the sphere or outside of it, in its own color.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.fruit.spheres import SphereFit, shell_of
from greenhouse_gym.shapes.fruit.trusses import NEIGHBOR_GAP
from greenhouse_gym.shapes.robust_fit import quantiles
from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud

SPHERE_FEATURES = (
    "coverage", "coverage^2", "log points", "rmse / mm", "alignment", "inside", "overshoot", "crossing",
    "smaller curvature", "larger curvature", "log plane rmse / rmse", "filled", "contrast",
    "hue spread", "log radius", "patch's smaller curvature", "patch's larger curvature",
)  # fmt: skip
"""Names of the columns of `sphere_features`."""

MAX_CONTRAST = 0.5
"""Cap on the contrast with leaves, in steps of 0.1 of redness: fruit may be redder, by however much."""

_OVERSHOOT = 0.010  # metres outside of the shell in which a continuing surface is counted
_MAX_CURVATURE = 2.5  # cap on curvatures, as a multiple of the sphere's own

_EDGES = (0.0, 0.5, 0.8, 0.93, 1.07, 1.2, 1.5, 2.0)  # of the shells, in radii
_SKIN = 3  # the shell of the sphere's own surface
_PER_SHELL = ("filled", "facing", "redder", "brighter")

SHELL_FEATURES = tuple(f"{name}, shell {k}" for k in range(len(_EDGES) - 1) for name in _PER_SHELL)
"""Names of the columns of `shell_features`.

For each shell from the center outwards: the logarithm of its number of points as a fraction of half a sphere's, the
mean cosine between their normals and the sphere's, and by how much they are redder and brighter than the skin. The skin
itself is compared with the leaves in redness, and its brightness is replaced by the brightness's standard deviation.
"""

COLOR_FEATURES = tuple(k for k, name in enumerate(SHELL_FEATURES) if name.startswith(("redder", "brighter")))
"""Indices of the features that depend on color."""

_PER_POINT = 20.0  # scale of the logarithm of the number of points
_HUE_UNIT, _BRIGHTNESS_UNIT = 0.1, 0.1  # redness and brightness that count as 1
_MAX_DIFFERENCE = 3.0  # cap on color differences, in these units
_BATCH = 1000  # spheres measured at once

CONTEXT_FEATURES = ("larger", "smaller", "unlike neighbors", "neighbors", "gap / cm", "unlike hue")
"""Names of the columns of `context_features`."""


def sphere_features(fits: Sequence[SphereFit], cloud: SurfaceCloud) -> Array:
    """Return the features (k, len(SPHERE_FEATURES)) of single spheres among all points of a cloud."""
    tree = cKDTree(cloud.points)
    return np.array([_features(fit, cloud, tree) for fit in fits]).reshape(-1, len(SPHERE_FEATURES))


def _features(fit: SphereFit, cloud: SurfaceCloud, tree: cKDTree) -> list[float]:
    shell = shell_of(fit.radius)
    near = np.array(tree.query_ball_point(fit.center, fit.radius + shell + _OVERSHOOT), dtype=np.int64)
    offset = cloud.points[near] - fit.center
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    unit, residual = offset / distance[:, None], distance - fit.radius
    cosine = (unit * cloud.normals[near]).sum(axis=1)
    skin = np.abs(residual) < shell
    on = skin & (cosine > 0.7)
    count = max(int(np.count_nonzero(on)), 1)
    inside, overshoot, crossing = (
        float(np.log1p(int(np.count_nonzero(mask)) / count))
        for mask in (residual < -shell, residual > shell, skin & (cosine < 0.4))
    )
    if not on.any():
        on = skin
    own = offset[on] - offset[on].mean(axis=0)
    curvatures = (quantiles(cloud.curvatures[near[on]], 0.5) * fit.radius).clip(-1.0, _MAX_CURVATURE)
    spread = np.linalg.eigvalsh(own.T @ own / (len(own) - 1)) if len(own) > 3 else np.ones(3)
    even = float(np.log((np.sqrt(max(spread[0], 0.0)) + 1e-4) / (fit.rmse + 1e-4)))
    middle = float(np.linalg.norm(unit[on].mean(axis=0)))  # 1 - |middle| of a cap is the fraction of the sphere
    low, hue, high = quantiles(cloud.hues[near[on]], np.array([0.25, 0.5, 0.75]))
    contrast = 0.0
    if cloud.leaf_hue > NO_LEAF:
        contrast = float(np.clip((hue - cloud.leaf_hue) / 0.1, -MAX_CONTRAST, MAX_CONTRAST))
    return [
        fit.coverage, fit.coverage**2, float(np.log(count)), 1e3 * fit.rmse, fit.alignment, inside, overshoot, crossing,
        float(curvatures[0]), float(curvatures[1]), even, fit.coverage / (1.02 - middle), contrast,
        float(high - low) / 0.1, float(np.log(fit.radius / 0.025)),
        *_patch_curvatures(unit[skin], cloud.normals[near[skin]]),
    ]  # fmt: skip


def _patch_curvatures(outward: Array, normals: Array) -> list[float]:
    """Return the two curvatures of a patch, the smaller first, by a linear fit of its normals; a sphere's are 1.

    Args:
        outward: (k, 3) unit vectors from the sphere's center to the points.
        normals: (k, 3) normals of the points.
    """
    if len(outward) < 4:
        return [0.0, 0.0]
    offset, turned = outward - outward.mean(axis=0), normals - normals.mean(axis=0)
    across = np.linalg.eigh(offset.T @ offset)[1][:, 1:]  # the two directions in which the patch is widest
    along = offset @ across
    extent = along.T @ along + 1e-3 * len(offset) * np.eye(2)
    slope = np.linalg.solve(extent, along.T @ (turned @ across))
    return np.linalg.eigvalsh((slope + slope.T) / 2).clip(-1.0, _MAX_CURVATURE).tolist()


def shell_features(fits: Sequence[Sphere], cloud: SurfaceCloud, spacing: float) -> Array:
    """Return the features (k, len(SHELL_FEATURES)) of spheres in a cloud with one point per ``spacing`` metres."""
    tree = cKDTree(cloud.points)
    batches = [_batch_features(fits[k : k + _BATCH], cloud, tree, spacing) for k in range(0, len(fits), _BATCH)]
    return np.concatenate([np.zeros((0, len(SHELL_FEATURES))), *batches])


def _batch_features(fits: Sequence[Sphere], cloud: SurfaceCloud, tree: cKDTree, spacing: float) -> Array:
    centers, radii = np.array([fit.center for fit in fits]), np.array([fit.radius for fit in fits])
    members = tree.query_ball_point(centers, _EDGES[-1] * radii)
    owner = np.repeat(np.arange(len(fits)), [len(rows) for rows in members])
    near = np.concatenate(members).astype(np.int64)
    offset = cloud.points[near] - centers[owner]
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    facing = (offset * cloud.normals[near]).sum(axis=1) / distance
    shells = len(_EDGES) - 1
    shell = np.minimum(np.searchsorted(_EDGES, distance / radii[owner], "right") - 1, shells - 1)
    hues, brightness = cloud.hues[near] / _HUE_UNIT, cloud.colors[near].mean(axis=1) / _BRIGHTNESS_UNIT

    def shell_sums(weights: Array | None = None) -> Array:
        sums = np.bincount(owner * shells + shell, weights, minlength=len(fits) * shells)
        return sums.reshape(len(fits), shells).astype(np.float64)

    count, on_skin = shell_sums(), shell == _SKIN
    divisor = np.maximum(count, 1.0)
    red, bright = (_medians(values[on_skin], owner[on_skin], len(fits)) for values in (hues, brightness))
    mean = shell_sums(brightness) / divisor
    redder, brighter = shell_sums(hues) / divisor - red[:, None], mean - bright[:, None]
    redder[:, _SKIN] = red - cloud.leaf_hue / _HUE_UNIT if cloud.leaf_hue > NO_LEAF else 0.0
    variance = shell_sums((brightness - mean[owner, shell]) ** 2) / divisor
    brighter[:, _SKIN] = np.sqrt(variance[:, _SKIN])
    half = 2 * np.pi * radii**2 / spacing**2
    filled = np.log1p(_PER_POINT * count / half[:, None])
    differences = np.clip([redder, brighter], -_MAX_DIFFERENCE, _MAX_DIFFERENCE)
    features = np.stack([filled, shell_sums(facing) / divisor, *differences], axis=2)
    features[count == 0] = 0.0
    return features.reshape(len(fits), len(SHELL_FEATURES))


def _medians(values: Array, owner: npt.NDArray[np.int64], count: int) -> Array:
    """Return the median (count,) of the values (n,) of each owner; 0 for owners without values."""
    each = np.bincount(owner, minlength=count)
    ordered = np.append(values[np.lexsort((values, owner))], 0.0)
    before = np.cumsum(each) - each
    middle = (ordered[before + np.maximum(each - 1, 0) // 2] + ordered[before + each // 2]) / 2
    return np.where(each > 0, middle, 0.0)


def context_features(
    fits: Sequence[SphereFit], hues: Array, confident: Sequence[SphereFit], confident_hues: Array
) -> Array:
    """Return the features (k, len(CONTEXT_FEATURES)) of spheres among confident fruit; zeros without any.

    Args:
        fits: The spheres.
        hues: (k,) hue of each sphere.
        confident: Spheres that certainly are tomatoes.
        confident_hues: (s,) hue of each of these.
    """
    if not len(confident):
        return np.zeros((len(fits), len(CONTEXT_FEATURES)))
    centers, radii = np.array([s.center for s in confident]), np.array([s.radius for s in confident])
    usual = float(np.median(radii))
    rows = []
    for fit, hue in zip(fits, hues.tolist(), strict=True):
        distance = np.linalg.norm(centers - fit.center, axis=1)
        gap = np.where(distance > 0.5 * radii, distance - radii - fit.radius, np.inf)  # not to itself
        neighbors = gap < NEIGHBOR_GAP
        size = float(np.log(fit.radius / usual))
        unlike = abs(float(np.log(fit.radius / np.median(radii[neighbors])))) if neighbors.any() else abs(size)
        nearest = int(gap.argmin())
        rows.append([
            max(size, 0.0), max(-size, 0.0), unlike, float(np.log1p(np.count_nonzero(neighbors))),
            float(np.clip(gap[nearest] / 0.01, 0.0, 5.0)),
            abs(float(hue - confident_hues[nearest])) / 0.1 if neighbors.any() else 0.0,
        ])  # fmt: skip
    return np.array(rows).reshape(-1, len(CONTEXT_FEATURES))
