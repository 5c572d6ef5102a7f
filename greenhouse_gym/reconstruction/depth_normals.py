"""Surface normals of a depth image: a plane is linear in inverse depth, so box filters fit one at every pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.extras import needs
from greenhouse_gym.geometry import Array

with needs("reconstruct"):
    import cv2


def image_normals(
    depth: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], intrinsics: Intrinsics, window: int = 7
) -> Array:
    """Return unit normals toward the camera at the masked pixels of a depth image, in the camera frame.

    With x' = (u - cx) / fx and y' = (v - cy) / fy, the points of a plane n . X = d have 1/z = (n . (x', y', 1)) / d, so
    a linear fit of inverse depth in a window gives the normal's direction. Only masked pixels count, and all must
    have a reading, so the background of a surface does not bend its normals.

    Returns:
        (n, 3) unit vectors in the order of ``np.nonzero(mask)``; opposite to the line of sight where no fit exists.
    """
    k = intrinsics
    x = ((np.arange(k.width) - k.cx) / k.fx)[None, :].astype(np.float32)
    y = ((np.arange(k.height) - k.cy) / k.fy)[:, None].astype(np.float32)
    pixels = np.flatnonzero(mask)
    weight = mask.astype(np.float32)
    inverse = np.zeros(depth.shape, dtype=np.float32)
    inverse.ravel()[pixels] = 1.0 / depth.ravel()[pixels]

    def window_sum(image: npt.NDArray[np.float32]) -> Array:
        summed = cv2.boxFilter(image, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed).ravel()[pixels].astype(np.float64)  # the filter adds up in float64 inside

    n = window_sum(weight)
    in_x, in_y = weight * x, weight * y
    mean_x, mean_y, mean_d = (window_sum(image) / n for image in (in_x, in_y, inverse))
    xx = window_sum(in_x * x) / n - mean_x**2
    yy = window_sum(in_y * y) / n - mean_y**2
    xy = window_sum(in_x * y) / n - mean_x * mean_y
    xd = window_sum(inverse * x) / n - mean_x * mean_d
    yd = window_sum(inverse * y) / n - mean_y * mean_d
    # a small ridge, a hundredth of a pixel squared, keeps lines of pixels solvable
    xx, yy = xx + 0.01 / k.fx**2, yy + 0.01 / k.fy**2
    determinant = xx * yy - xy**2
    a, b = (xd * yy - yd * xy) / determinant, (yd * xx - xd * xy) / determinant
    c = mean_d - a * mean_x - b * mean_y
    rows, columns = np.divmod(pixels, k.width)
    ray_x, ray_y = x[0, columns], y[rows, 0]
    size = np.sqrt(a * a + b * b + c * c)
    toward = -np.sign(a * ray_x + b * ray_y + c) / np.maximum(size, 1e-9)
    normals = np.column_stack([a * toward, b * toward, c * toward])
    if (flat := size <= 1e-9).any():
        against = -np.column_stack([ray_x, ray_y, np.ones(len(pixels))])[flat]
        normals[flat] = against / np.linalg.norm(against, axis=1, keepdims=True)
    return normals
