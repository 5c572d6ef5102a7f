"""Normals of a cloud that came without."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud, to_open3d, voxel_means
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.settings import ShapeSettings

_REACH = 0.009  # metres: a plane is laid through the points this near
_NEIGHBORS = 60  # most points that a plane is laid through
_PIECE = 0.005  # metres: which side is out is decided for pieces of this size
_AROUND = 0.014  # metres: what is this near decides on a piece
_BULGE = 4e-3  # metres by which a piece stands out that tells as much as a look right at it
_ROUNDS = 8  # in which neighbors agree upon a side
_CLEAR_BULGE = 4e-4  # metres
_ONE_SIDE = 0.03  # mean of the unit normals of what bulges clearly; less was seen from all sides
_UNKNOWN_SIDE = np.array([-0.3, 0.0, 0.0])  # where nothing tells, the aisle is more likely
_CELL = 0.010  # metres: what is thin and long is told at this size
_ROD_REACH = 0.030  # metres
_LONG = 4.0  # times as much as across must points vary along a rod


def estimate_normals(points: Array, settings: ShapeSettings) -> Array:
    """Unit normals (n, 3) of points (n, 3), one per voxel, nobody knows seen from where.

    Fruit and stems bulge towards who looks at them, so what bulges tells on the whole from which side a cloud was seen,
    and each piece by itself, a little, which of its sides is out; pieces that go on into each other agree upon it. On a
    rod, a stem for instance, normals are made perpendicular to its axis and point away from the middle of what is near,
    which is right whether it was seen from all sides or from one.
    """
    if len(points) < 3:
        return np.tile([-1.0, 0.0, 0.0], (len(points), 1))
    bare = Cloud(points, np.zeros_like(points), np.zeros_like(points))
    cloud = to_open3d(bare)
    cloud.estimate_normals(open3d().geometry.KDTreeSearchParamHybrid(_REACH, _NEIGHBORS))
    normals = np.array(cloud.normals)
    inwards = (_outward(bare, points) * normals).sum(axis=1) < 0
    normals[inwards] *= -1.0
    cells, cell = voxel_means(bare, _CELL)
    near = Neighborhoods(cells.points, _ROD_REACH)
    variances, axes = np.linalg.eigh(near.covariances(cells.points, cells.points))
    on_rod = (variances[:, 2] > _LONG * variances[:, 1])[cell]
    axis, out = axes[cell[on_rod], :, 2], points[on_rod] - near.mean(cells.points)[cell[on_rod]]
    rods = normals[on_rod]
    rods -= (rods * axis).sum(axis=1, keepdims=True) * axis
    rods *= np.where((rods * out).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    normals[on_rod] = rods / np.maximum(np.linalg.norm(rods, axis=1, keepdims=True), 1e-9)
    return normals


def _outward(bare: Cloud, points: Array) -> Array:
    """Vectors (n, 3) that point out of the surfaces, roughly."""
    cells, cell = voxel_means(bare, _PIECE)
    near = Neighborhoods(cells.points, _AROUND)
    axes = np.linalg.eigh(near.covariances(cells.points, cells.points))[1][:, :, 0]
    bulge = ((cells.points - near.mean(cells.points)) * axes).sum(axis=1)
    clear = np.abs(bulge) > _CLEAR_BULGE
    side = (np.sign(bulge[clear])[:, None] * axes[clear]).sum(axis=0) / max(np.count_nonzero(clear), 1)
    length = float(np.linalg.norm(side))
    view = side / length if length > _ONE_SIDE else _UNKNOWN_SIDE
    out = (axes @ view + np.clip(bulge, -_BULGE / 2, _BULGE / 2) / _BULGE)[:, None] * axes
    for _ in range(_ROUNDS):
        out = near.mean(out)
    return np.asarray(out[cell])
