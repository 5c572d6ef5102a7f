"""Surface points that a camera at the wrist sees as plants move: those that it looks through later are given up."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmSpheres
from greenhouse_gym.rendering.cameras import DepthCamera

_CELL = 0.012  # metres: side of the cells that keep one point each
_BEHIND = 0.03  # metres behind a point that the camera sees when the point is gone
_ARM, _FAR = 0.015, 0.9  # metres: points so near to the arm, or so far from the camera, are left out


class SeenSurface:
    """Points on surfaces other than the arm.

    Args:
        arm: The arm.
        camera: The camera.

    Attributes:
        points: (n, 3) in the frame of the arm's base, metres.
    """

    def __init__(self, arm: ArmSpheres, camera: DepthCamera):
        self._arm, self._camera = arm, camera
        self.points: Array = np.empty((0, 3))

    def see(self, depth: Array, points: Array, view: tuple[Array, Array], joints: Array) -> None:
        """Add an image, and remove the points that it looks through.

        Args:
            depth: (m,) depth at the pixels, metres; 0 without a reading.
            points: (m, 3) points at the pixels.
            view: Rotation (3, 3) and position (3,) of the camera.
            joints: (j,) configuration of the arm, radians.
        """
        kept = self.points[~self._gone(depth, *view)]
        new = points[(depth > 0) & (depth < _FAR)]
        if len(new):
            new = new[_first(new)]
            apart = cdist(new, self._arm.centers(joints[None])[0]) - self._arm.radius
            new = new[apart.min(axis=1) > _ARM]
        points = np.concatenate([kept, new])
        self.points = points[_first(points)] if len(points) else points

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
