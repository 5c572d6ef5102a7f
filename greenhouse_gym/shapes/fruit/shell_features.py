"""Features of the concentric shells in and around a sphere: fruit is hollow, and its surface ends at its skin.

The tip of a leaf is curved like a small fruit, but its surface continues through the sphere or outside of it, in its
own color.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud

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


def shell_features(fits: Sequence[Sphere], cloud: SurfaceCloud, spacing: float) -> Array:
    """Return the features (k, len(SHELL_FEATURES)) of spheres in a cloud with one point per ``spacing`` metres."""
    tree = cKDTree(cloud.points)
    batches = [_features(fits[k : k + _BATCH], cloud, tree, spacing) for k in range(0, len(fits), _BATCH)]
    return np.concatenate([np.zeros((0, len(SHELL_FEATURES))), *batches])


def _features(fits: Sequence[Sphere], cloud: SurfaceCloud, tree: cKDTree, spacing: float) -> Array:
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
