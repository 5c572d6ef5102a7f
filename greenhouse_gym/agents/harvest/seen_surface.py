"""Surface points that a camera at the wrist sees as plants move: those that it looks through later are given up."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmSpheres
from greenhouse_gym.rendering.cameras import DepthCamera

_CELL = 0.012  # metres: side of the cells that keep one point each
_BEHIND = 0.03  # metres behind a point that the camera sees when the point is gone
_BROAD, _LAYER = 0.025, 0.03  # metres: width from which a thing is broad, and depth within which it is one thing
_SIZES = (3, 5, 7, 9)  # pixels: sides of squares that fit into broad things
_ARM, _FAR = 0.015, 0.9  # metres: points so near to the arm, or so far from the camera, are left out


class SeenSurface:
    """Points on surfaces other than the arm.

    Args:
        arm: The arm.
        camera: The camera.
        known: Returns which points (n, 3), in the frame of the base, belong to something known, and are left out.

    Attributes:
        points: (n, 3) in the frame of the arm's base, metres.
        broad: (n,) whether they belong to broad things such as leaves, and not to thin ones such as stems.
    """

    def __init__(self, arm: ArmSpheres, camera: DepthCamera, known: Callable[[Array], npt.NDArray[np.bool_]]):
        self._arm, self._camera, self._known = arm, camera, known
        self.points: Array = np.empty((0, 3))
        self.broad = np.empty(0, dtype=np.bool_)

    def see(self, depth: Array, points: Array, view: tuple[Array, Array], joints: Array) -> None:
        """Add an image, and remove the points that it looks through.

        Args:
            depth: (m,) depth at the pixels, metres; 0 without a reading.
            points: (m, 3) points at the pixels.
            view: Rotation (3, 3) and position (3,) of the camera.
            joints: (j,) configuration of the arm, radians.
        """
        kept = ~self._gone(depth, *view)
        new = np.flatnonzero((depth > 0) & (depth < _FAR))
        new = new[_first(points[new])]
        new = new[~self._arm.near(points[new], joints[None], _ARM)]
        new = new[~self._known(points[new])]
        broad = self._broad(depth)[new]
        # the newer the nearer, and the nearer the better a thing shows its width
        points = np.concatenate([points[new], self.points[kept]])
        first = _first(points)
        self.points, self.broad = points[first], np.concatenate([broad, self.broad[kept]])[first]

    def _broad(self, depth: Array) -> npt.NDArray[np.bool_]:
        """Return which pixels (m,) belong to squares of some width at about one depth."""
        image = np.where(depth > 0, depth, 1e3).reshape(self._camera.height, self._camera.width)
        broad = np.zeros(image.shape, dtype=np.bool_)
        pixels = _BROAD * self._camera.focal / image
        sizes = np.clip(np.searchsorted(_SIZES, pixels), 0, len(_SIZES) - 1)
        for k, size in enumerate(_SIZES):
            flat = maximum_filter(image, size) - minimum_filter(image, size) < _LAYER
            broad |= (sizes == k) & binary_dilation(flat, np.ones((size, size))) & (image < _FAR)
        return broad.ravel()

    def _gone(self, depth: Array, turn: Array, origin: Array) -> npt.NDArray[np.bool_]:
        """Return which points the camera would see if they were still there."""
        camera = self._camera
        x, y, z = ((self.points - origin) @ turn).T
        ahead = np.maximum(z, 1e-3)
        column = np.floor(x / ahead * camera.focal + camera.width / 2).astype(np.int64)
        row = np.floor(y / ahead * camera.focal + camera.height / 2).astype(np.int64)
        inside = (z > _CELL) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        seen = depth[np.where(inside, row * camera.width + column, 0)]
        return np.asarray(inside & ((seen > z + _BEHIND) | (seen == 0)))


def _first(points: Array) -> npt.NDArray[np.int64]:
    """Return the first of the points (n, 3) in each cell."""
    return np.unique(np.floor(points / _CELL).astype(np.int64), axis=0, return_index=True)[1]
