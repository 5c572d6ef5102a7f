"""Features of single spheres that distinguish fruit from curved leaves.

A leaf that curves in one direction only, or that continues outside of the sphere or through it, is no fruit. Color is
compared with the leaves of the same cloud only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.fruit.spheres import SphereFit, shell_of
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
