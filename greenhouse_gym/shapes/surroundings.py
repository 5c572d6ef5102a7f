"""What lies in a sphere, on it and around it, shell by shell: fruit is hollow, and nothing of it is beside it.

The tip of a leaf is bent like a small fruit, but its surface goes on through the sphere or beyond it, in its own color.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
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


def surroundings(fits: Sequence[Sphere], cloud: SurfaceCloud, spacing: float) -> Array:
    """Measures (k, len(SURROUNDINGS)) of spheres in a cloud with a point per ``spacing`` metres."""
    tree = cKDTree(cloud.points)
    tones = cloud.tones / _TONE
    leaf = cloud.leaf / _TONE if cloud.leaf > NO_LEAF else None
    brightness = cloud.colors.mean(axis=1) / _BRIGHT
    rows = np.zeros((len(fits), len(_EDGES) - 1, len(_OF_SHELL)))
    for row, fit in zip(rows, fits, strict=True):
        near = np.array(tree.query_ball_point(fit.center, _EDGES[-1] * fit.radius), dtype=np.int64)
        away = cloud.points[near] - fit.center
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        facing = (away * cloud.normals[near]).sum(axis=1) / distance
        shell = np.minimum(np.searchsorted(_EDGES, distance / fit.radius, "right") - 1, len(row) - 1)
        half = 2 * np.pi * fit.radius**2 / spacing**2
        on = near[shell == _SKIN]
        red, bright = (float(np.median(values[on])) if len(on) else 0.0 for values in (tones, brightness))
        for k in np.unique(shell).tolist():
            own = shell == k
            values = tones[near[own]].mean() - red, brightness[near[own]].mean() - bright
            if k == _SKIN:
                values = 0.0 if leaf is None else red - leaf, brightness[on].std()
            row[k] = np.log1p(_PER_SHARE * len(near[own]) / half), facing[own].mean(), *np.clip(values, -_MOST, _MOST)
    return rows.reshape(len(fits), len(SURROUNDINGS))
