"""Surface normals straight from a depth image: a plane is linear in inverse depth, so box filters fit it everywhere."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.geometry import Array


def image_normals(
    depth: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], intrinsics: Intrinsics, window: int = 7
) -> Array:
    """Unit normals toward the camera at the masked pixels, in the camera frame.

    With x' = (u - cx) / fx and y' = (v - cy) / fy, the points of a plane n . X = d have 1/z = (n . (x', y', 1)) / d, so
    a linear fit of inverse depth in a window gives the normal's direction. Only masked pixels count, so a surface cut
    out of its background is not bent towards it.

    Args:
        depth: (height, width) metres.
        mask: (height, width) pixels to use; all must have a reading.
        intrinsics: The camera's.
        window: Side of the window, pixels.

    Returns:
        (n, 3) unit vectors in the order of ``np.nonzero(mask)``; against the line of sight where a fit is not possible.
    """
    k = intrinsics
    x = ((np.arange(k.width) - k.cx) / k.fx)[None, :]
    y = ((np.arange(k.height) - k.cy) / k.fy)[:, None]
    weight = mask.astype(np.float64)
    inverse = np.where(mask, 1.0 / np.where(mask, depth, 1.0), 0.0).astype(np.float64)

    def window_sum(image: Array) -> Array:
        summed = cv2.boxFilter(image, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed)[mask]

    n = window_sum(weight)
    mean_x, mean_y, mean_d = (window_sum(image) / n for image in (weight * x, weight * y, inverse))
    xx = window_sum(weight * x * x) / n - mean_x**2
    yy = window_sum(weight * y * y) / n - mean_y**2
    xy = window_sum(weight * x * y) / n - mean_x * mean_y
    xd = window_sum(inverse * x) / n - mean_x * mean_d
    yd = window_sum(inverse * y) / n - mean_y * mean_d
    # a small ridge, a hundredth of a pixel squared, keeps lines of pixels solvable
    xx, yy = xx + 0.01 / k.fx**2, yy + 0.01 / k.fy**2
    determinant = xx * yy - xy**2
    a, b = (xd * yy - yd * xy) / determinant, (yd * xx - xd * xy) / determinant
    normals = np.column_stack([a, b, mean_d - a * mean_x - b * mean_y])
    rows, columns = np.nonzero(mask)
    rays = np.column_stack([x[0, columns], y[rows, 0], np.ones(len(rows))])
    normals *= -np.sign((normals * rays).sum(axis=1, keepdims=True))
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    fallback = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.where(size > 1e-9, normals / np.maximum(size, 1e-9), fallback)
