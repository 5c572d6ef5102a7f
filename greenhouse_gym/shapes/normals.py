"""Normals of a cloud that came without."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction.clouds import Cloud, to_open3d, voxel_means
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.settings import ShapeSettings

_NEIGHBORS = 12
_CELL = 0.010  # metres: what is thin and long is told at this size
_LONG = 4.0  # times as much as across must points vary along a rod


def estimate_normals(points: Array, settings: ShapeSettings) -> Array:
    """Unit normals (n, 3) of points (n, 3), one per voxel, nobody knows seen from where.

    On a rod, a stem for instance, they are made perpendicular to its axis and point away from the middle of what is
    near, which is right whether it was seen from all sides or from one. Elsewhere they are turned against x, towards
    the camera.
    """
    if len(points) < 3:
        return np.tile([-1.0, 0.0, 0.0], (len(points), 1))
    bare = Cloud(points, np.zeros_like(points), np.zeros_like(points))
    cloud = to_open3d(bare)
    cloud.estimate_normals(open3d().geometry.KDTreeSearchParamKNN(_NEIGHBORS))
    cloud.orient_normals_to_align_with_direction([-1.0, 0.0, 0.0])
    normals = np.array(cloud.normals)
    cells, cell = voxel_means(bare, _CELL)
    near = Neighborhoods(cells.points, 3 * settings.stem_radii[1])
    variances, axes = np.linalg.eigh(near.covariances(cells.points, cells.points))
    on_rod = (variances[:, 2] > _LONG * variances[:, 1])[cell]
    axis, out = axes[cell[on_rod], :, 2], points[on_rod] - near.mean(cells.points)[cell[on_rod]]
    rods = normals[on_rod]
    rods -= (rods * axis).sum(axis=1, keepdims=True) * axis
    rods *= np.where((rods * out).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    normals[on_rod] = rods / np.maximum(np.linalg.norm(rods, axis=1, keepdims=True), 1e-9)
    return normals
