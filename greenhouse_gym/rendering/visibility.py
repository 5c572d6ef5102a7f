"""Visible fractions of spheres in a camera's view, by rays spread over the silhouette of each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.cameras import DepthCamera

RAYS = 48
"""Number of rays to a sphere."""

_INDEX = np.arange(RAYS) + 0.5
_RADIUS, _ANGLE = np.sqrt(_INDEX / RAYS), _INDEX * np.pi * (3.0 - np.sqrt(5.0))
_DISC = np.stack([_RADIUS * np.cos(_ANGLE), _RADIUS * np.sin(_ANGLE)])  # evenly spread (Vogel, 1979)

FirstHits = Callable[[Array], npt.NDArray[np.int64]]
"""Function from rays (m, 3) in the camera frame to the ids (m,) of the geoms that they hit first."""


def visible_fractions(
    camera: DepthCamera, spheres: Array, geoms: npt.NDArray[np.int64], depths: tuple[float, float], cast: FirstHits
) -> Array:
    """Return the fraction (k,) of the silhouette of each sphere that is in the image and not hidden.

    Args:
        camera: The camera; the size of its pixels does not matter.
        spheres: (k, 4) centers in the camera frame and radii, metres.
        geoms: (k,) ids of their geoms.
        depths: Smallest and largest depth of a center along the view, metres; others count as not visible.
        cast: Casts rays.
    """
    result = np.zeros(len(spheres))
    (near, far), edge = depths, np.array([camera.width, camera.height]) / (2 * camera.focal)
    center, radius = spheres[:, :3], spheres[:, 3]
    depth = np.maximum(center[:, 2], 1e-9)
    in_image = (np.abs(center[:, :2]) < edge * depth[:, None]).all(axis=1)
    chosen = np.flatnonzero(in_image & (center[:, 2] > near) & (center[:, 2] < far))
    if not len(chosen):
        return result
    center, radius = center[chosen], radius[chosen]
    squared = (center * center).sum(axis=1)
    across = np.cross(center, [0.0, 1.0, 0.0])
    across /= np.sqrt((across * across).sum(axis=1))[:, None]
    up = np.cross(across, center) / np.sqrt(squared)[:, None]
    # the silhouette of a sphere is the circle where the cone around it touches, at the distance of its center
    size = radius / np.sqrt(np.maximum(1.0 - radius**2 / squared, 1e-6))
    offsets = _DISC[0, :, None] * across[:, None] + _DISC[1, :, None] * up[:, None]
    rays = center[:, None] + size[:, None, None] * offsets
    inside = (rays[..., 2] > 0) & (np.abs(rays[..., :2]) < edge * rays[..., 2:]).all(axis=-1)
    hit = np.full(inside.shape, -1, dtype=np.int64)
    hit[inside] = cast(rays[inside])
    result[chosen] = (hit == geoms[chosen, None]).mean(axis=1)
    return result
