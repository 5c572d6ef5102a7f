"""Features that compare spheres with the row's confident fruit: in size with all, in size and hue with neighbors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.fruit.spheres import SphereFit
from greenhouse_gym.shapes.fruit.trusses import NEIGHBOR_GAP

CONTEXT_FEATURES = ("larger", "smaller", "unlike neighbors", "neighbors", "gap / cm", "unlike hue")
"""Names of the columns of `context_features`."""


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
