"""What depth images tell of the space before a camera: perfect ones, and ones with a stereo camera's noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_erosion, grey_dilation, label, maximum

from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera, stereo_noise

TRUSTED = 0.006
"""Readings whose doubt is larger say nothing, metres."""

_SIGMAS = 3.0  # of a reading's noise that are its doubt
_WINDOW, _ALIKE = 5, 3.0  # pixels over which disparities are averaged, and how much they may differ, in their noise
_LEFT = 0.5  # share of the noise that is left by the average, as neighbors partly share theirs
_AROUND = np.ones((3, 3), dtype=np.bool_)
_BORDER = (5, 5)  # pixels about a part without readings in which its neighbors are
_TOO_NEAR = 1.5  # what has no reading and borders on what is so near, in the least range, may be nearer than that


@dataclass(frozen=True)
class DepthReading:
    """What an image of h by w pixels tells.

    Attributes:
        depth: (h, w) along the view to what is seen on a surface, metres; 0 where nothing is.
        doubt: (h, w) by how much that may be wrong, metres.
        through: (h, w) up to which depth there is nothing, metres.
    """

    depth: Array
    doubt: Array
    through: Array


def perfect_reading(depth: npt.NDArray[np.float32]) -> DepthReading:
    """Take an image (h, w), metres, at its word.

    Where readings are missing side by side there is nothing; a single one missing among others may be a lost one.
    """
    z = depth.astype(np.float64)
    nothing = binary_erosion(z == 0, _AROUND, border_value=1)
    return DepthReading(z, np.zeros_like(z), np.where(nothing, MAX_RANGE, z))


def stereo_reading(depth: npt.NDArray[np.float32], camera: DepthCamera) -> DepthReading:
    """Read an image (h, w), metres, as one with the noise of a D435.

    Disparities are averaged where they are alike (a bilateral filter; Tomasi and Manduchi, 1998), and what is still in
    doubt by more than `TRUSTED` is not believed. A pixel without a reading shows nothing up to a depth below which the
    right imager sees what is there: it does not see what is beside its image, or behind something nearer. What borders
    on things at the end of the camera's range may be too near for it, and tells nothing.
    """
    noise = stereo_noise(camera)
    scale, rough = camera.focal * noise.baseline, noise.disparity_noise
    read = depth > 0
    disparity = np.where(read, scale / np.where(read, depth.astype(np.float64), 1.0), 0.0)
    z = np.where(read, scale / np.where(read, _averaged(disparity, _ALIKE * rough), 1.0), 0.0)
    doubt = _SIGMAS * _LEFT * rough * z**2 / scale
    farthest = float(np.sqrt(TRUSTED * scale / (_SIGMAS * _LEFT * rough)))
    empty = np.where(_tells_nothing(disparity, noise.min_range, scale), 0.0, _free(disparity, scale))
    through = np.minimum(np.where(read, z, empty), farthest)
    return DepthReading(np.where(z <= farthest, z, 0.0), doubt, through)


def _averaged(disparity: Array, alike: float) -> Array:
    """Disparities (h, w), each averaged with those about it, the more alike they are the more."""
    about = np.lib.stride_tricks.sliding_window_view(np.pad(disparity, _WINDOW // 2), (_WINDOW, _WINDOW))
    weight = np.exp(-0.5 * ((about - disparity[:, :, None, None]) / alike) ** 2)
    return np.asarray((weight * about).sum(axis=(2, 3)) / weight.sum(axis=(2, 3)))


def _free(disparity: Array, scale: float) -> Array:
    """(h, w) depth up to which the right imager would have seen something, metres."""
    columns = np.arange(disparity.shape[1])
    right = np.where(disparity > 0, columns - disparity, np.inf)
    cover = np.full(disparity.shape, np.inf)
    cover[:, :-1] = np.minimum.accumulate(right[:, :0:-1], axis=1)[:, ::-1]
    hidden = np.maximum(columns - cover, 0.0)
    return np.minimum(MAX_RANGE, scale / np.maximum(hidden, 1e-9))


def _tells_nothing(disparity: Array, least: float, scale: float) -> npt.NDArray[np.bool_]:
    """(h, w) where a missing reading is a lost one, or one of something nearer than the least range, metres."""
    parts, count = label(binary_erosion(disparity == 0, _AROUND, border_value=1), _AROUND)
    beside = np.where(disparity > 0, grey_dilation(parts, size=_BORDER), 0)
    nearest = np.asarray(maximum(disparity, beside, np.arange(count + 1)))
    too_near = (nearest > scale / (_TOO_NEAR * least)) | (nearest == 0)  # or has no neighbors at all
    too_near[0] = True
    outside = np.arange(disparity.shape[1]) < scale / least
    return np.asarray(too_near[parts] | outside)
