"""What lies in a sphere, on it and around it, shell by shell: fruit is hollow, and nothing of it is beside it.

The tip of a leaf is bent like a small fruit, but its surface goes on through the sphere or beyond it, in its own color.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.surfaces import NO_LEAF, SurfaceCloud

_EDGES = (0.0, 0.5, 0.8, 0.93, 1.07, 1.2, 1.5, 2.0)  # radii
_SKIN = 3  # the shell that is the sphere's own
_OF_SHELL = ("filled", "facing", "redder", "brighter")

SURROUNDINGS = tuple(f"{name}, shell {k}" for k in range(len(_EDGES) - 1) for name in _OF_SHELL)
"""Names of what `surroundings` gives.

Of each shell from the center outwards: how many points it holds, in shares of those of half a sphere (a logarithm); the
mean cosine between their normals and the sphere's; and by how much they are redder and brighter than the skin. Of the
skin itself it is how much redder than leaves it is, and how much its brightness scatters.
"""

OF_COLOR = tuple(k for k, name in enumerate(SURROUNDINGS) if name.startswith(("redder", "brighter")))
"""Which of these are of color."""

_PER_SHARE = 20.0  # of a half sphere's points, below which the logarithm is nearly linear
_TONE, _BRIGHT = 0.1, 0.1  # redness and brightness that count as 1
_MOST = 3.0  # of these
_TOGETHER = 1000  # spheres that are looked at at once


def surroundings(fits: Sequence[Sphere], cloud: SurfaceCloud, spacing: float) -> Array:
    """Measures (k, len(SURROUNDINGS)) of spheres in a cloud with a point per ``spacing`` metres."""
    tree = cKDTree(cloud.points)
    found = [
        _surroundings(fits[first : first + _TOGETHER], cloud, tree, spacing) for first in range(0, len(fits), _TOGETHER)
    ]
    return np.concatenate([np.zeros((0, len(SURROUNDINGS))), *found])


def _surroundings(fits: Sequence[Sphere], cloud: SurfaceCloud, tree: cKDTree, spacing: float) -> Array:
    centers, radii = np.array([fit.center for fit in fits]), np.array([fit.radius for fit in fits])
    members = tree.query_ball_point(centers, _EDGES[-1] * radii)
    owner = np.repeat(np.arange(len(fits)), [len(rows) for rows in members])
    near = np.concatenate(members).astype(np.int64)
    away = cloud.points[near] - centers[owner]
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    facing = (away * cloud.normals[near]).sum(axis=1) / distance
    shells = len(_EDGES) - 1
    shell = np.minimum(np.searchsorted(_EDGES, distance / radii[owner], "right") - 1, shells - 1)
    tones, brightness = cloud.tones[near] / _TONE, cloud.colors[near].mean(axis=1) / _BRIGHT

    def of_shells(weights: Array | None = None) -> Array:
        sums = np.bincount(owner * shells + shell, weights, minlength=len(fits) * shells)
        return sums.reshape(len(fits), shells).astype(np.float64)

    count, on = of_shells(), shell == _SKIN
    some = np.maximum(count, 1.0)
    red, bright = (_medians(values[on], owner[on], len(fits)) for values in (tones, brightness))
    mean = of_shells(brightness) / some
    redder, brighter = of_shells(tones) / some - red[:, None], mean - bright[:, None]
    redder[:, _SKIN] = red - cloud.leaf / _TONE if cloud.leaf > NO_LEAF else 0.0
    spread = of_shells((brightness - mean[owner, shell]) ** 2) / some
    brighter[:, _SKIN] = np.sqrt(spread[:, _SKIN])
    half = 2 * np.pi * radii**2 / spacing**2
    filled = np.log1p(_PER_SHARE * count / half[:, None])
    colors = np.clip([redder, brighter], -_MOST, _MOST)
    measured = np.stack([filled, of_shells(facing) / some, *colors], axis=2)
    measured[count == 0] = 0.0
    return measured.reshape(len(fits), len(SURROUNDINGS))


def _medians(values: Array, owner: npt.NDArray[np.int64], count: int) -> Array:
    """Median (count,) of the values (n,) of each owner, 0 where one has none."""
    each = np.bincount(owner, minlength=count)
    ordered = np.append(values[np.lexsort((values, owner))], 0.0)
    before = np.cumsum(each) - each
    middle = (ordered[before + np.maximum(each - 1, 0) // 2] + ordered[before + each // 2]) / 2
    return np.where(each > 0, middle, 0.0)
