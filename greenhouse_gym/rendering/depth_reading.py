"""Depth images as surface points with error bounds and as free space, perfect ones and those of a stereo camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_erosion, grey_dilation, label, maximum

from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera, stereo_noise

MAX_UNCERTAINTY = 0.006
"""Readings with a larger error bound are dropped, metres."""

_SIGMAS = 3.0  # standard deviations of the noise in an error bound
_WINDOW, _SIMILAR = 5, 3.0  # pixels of the filter's window; its range, in standard deviations of disparity noise
_REMAINING = 0.5  # fraction of the noise that the filter leaves, as neighboring pixels share a part of theirs
_NEIGHBORS = np.ones((3, 3), dtype=np.bool_)
_BORDER = (5, 5)  # pixels around a hole that count as its border
_TOO_NEAR = 1.5  # holes that border on surfaces within this many minimum ranges may be something nearer than that

RAYS = 48
"""Number of rays to a sphere."""

_INDEX = np.arange(RAYS) + 0.5
_RADIUS, _ANGLE = np.sqrt(_INDEX / RAYS), _INDEX * np.pi * (3.0 - np.sqrt(5.0))
_DISC = np.stack([_RADIUS * np.cos(_ANGLE), _RADIUS * np.sin(_ANGLE)])  # evenly spread (Vogel, 1979)

FirstHits = Callable[[Array], npt.NDArray[np.int64]]
"""Function from rays (m, 3) in the camera frame to the ids (m,) of the geoms that they hit first."""


@dataclass(frozen=True)
class DepthReading:
    """Surface points and free space read from a depth image (h, w).

    Attributes:
        depth: (h, w) depth of a surface along the view, metres; 0 without a reading.
        uncertainty: (h, w) its error bound, metres.
        free: (h, w) depth up to which space is free, metres.
    """

    depth: Array
    uncertainty: Array
    free: Array


def perfect_reading(depth: npt.NDArray[np.float32]) -> DepthReading:
    """Interpret an image (h, w), metres, without noise.

    Holes are free space, except single pixels, which may be lost readings.
    """
    z = depth.astype(np.float64)
    nothing = binary_erosion(z == 0, _NEIGHBORS, border_value=1)
    return DepthReading(z, np.zeros_like(z), np.where(nothing, MAX_RANGE, z))


def stereo_reading(depth: npt.NDArray[np.float32], camera: DepthCamera) -> DepthReading:
    """Interpret an image (h, w), metres, with the noise of a D435.

    Similar neighboring disparities are averaged (a bilateral filter; Tomasi and Manduchi, 1998); readings that are then
    still uncertain by more than `MAX_UNCERTAINTY` are dropped. A hole is free space up to the depth beyond which the
    right imager may miss a surface: it does not see what lies beyond the edge of its image or behind something nearer.
    Holes that border on surfaces near the minimum range may be surfaces too near to be measured, so no space there is
    free.
    """
    noise = stereo_noise(camera)
    scale, disparity_noise = camera.focal * noise.baseline, noise.disparity_noise
    valid = depth > 0
    disparity = np.where(valid, scale / np.where(valid, depth.astype(np.float64), 1.0), 0.0)
    z = np.where(valid, scale / np.where(valid, _filtered(disparity, _SIMILAR * disparity_noise), 1.0), 0.0)
    uncertainty = _SIGMAS * _REMAINING * disparity_noise * z**2 / scale
    farthest = float(np.sqrt(MAX_UNCERTAINTY * scale / (_SIGMAS * _REMAINING * disparity_noise)))
    holes = np.where(_uninformative(disparity, noise.min_range, scale), 0.0, _free(disparity, scale))
    free = np.minimum(np.where(valid, z, holes), farthest)
    return DepthReading(np.where(z <= farthest, z, 0.0), uncertainty, free)


def _filtered(disparity: Array, similar: float) -> Array:
    """Return disparities (h, w) averaged with their neighbors, similar ones weighted more."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(disparity, _WINDOW // 2), (_WINDOW, _WINDOW))
    weight = np.exp(-0.5 * ((windows - disparity[:, :, None, None]) / similar) ** 2)
    return np.asarray((weight * windows).sum(axis=(2, 3)) / weight.sum(axis=(2, 3)))


def _free(disparity: Array, scale: float) -> Array:
    """Return the depth (h, w) up to which the right imager would have seen a surface, metres."""
    columns = np.arange(disparity.shape[1])
    right = np.where(disparity > 0, columns - disparity, np.inf)
    cover = np.full(disparity.shape, np.inf)
    cover[:, :-1] = np.minimum.accumulate(right[:, :0:-1], axis=1)[:, ::-1]
    hidden = np.maximum(columns - cover, 0.0)
    return np.minimum(MAX_RANGE, scale / np.maximum(hidden, 1e-9))


def _uninformative(disparity: Array, min_range: float, scale: float) -> npt.NDArray[np.bool_]:
    """Return a mask (h, w) of missing readings that may be lost, or surfaces nearer than the minimum range (metres)."""
    holes, count = label(binary_erosion(disparity == 0, _NEIGHBORS, border_value=1), _NEIGHBORS)
    border = np.where(disparity > 0, grey_dilation(holes, size=_BORDER), 0)
    nearest = np.asarray(maximum(disparity, border, np.arange(count + 1)))
    too_near = (nearest > scale / (_TOO_NEAR * min_range)) | (nearest == 0)  # or the hole has no border at all
    too_near[0] = True
    outside = np.arange(disparity.shape[1]) < scale / min_range
    return np.asarray(too_near[holes] | outside)


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
