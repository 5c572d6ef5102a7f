"""Means, moments and normals of the neighborhoods of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud, to_open3d, voxel_means

_REACH = 0.009  # metres: a plane is fitted to the points this near
_MAX_NEIGHBORS = 60  # points that a plane is fitted to
_PIECE = 0.005  # metres: size of the pieces that are oriented
_AROUND = 0.014  # metres: radius of the neighborhood that orients a piece
_BULGE = 4e-3  # metres of bulge that orient a piece as strongly as a frontal view
_ROUNDS = 8  # smoothing rounds over neighboring pieces
_CLEAR_BULGE = 4e-4  # metres of bulge that are not noise
_ONE_SIDED = 0.03  # mean of the bulging pieces' unit normals; below it the cloud was seen from all sides
_DEFAULT_VIEW = np.array([-0.3, 0.0, 0.0])  # weak prior for the side of the aisle
_ROD_CELL = 0.010  # metres: size of the pieces in which rods are detected
_ROD_REACH = 0.030  # metres
_ROD_ELONGATION = 4.0  # ratio of variances along and across a rod


class Neighborhoods:
    """Neighborhoods of points (n, 3): all points within ``reach`` metres of each, itself included.

    Attributes:
        count: (n,) number of points in each neighborhood.
    """

    def __init__(self, points: Array, reach: float):
        pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
        self._near = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(points),) * 2).tocsr()
        self.count: Array = np.asarray(self._near.sum(axis=0) + self._near.sum(axis=1) + 1.0)

    def mean(self, values: Array) -> Array:
        """Return the means (n, k) of values (n, k) over the neighborhoods."""
        return np.asarray((self._near @ values + self._near.T @ values + values) / self.count[:, None])

    def moments(self, a: Array, b: Array) -> Array:
        """Return the mean outer products (n, 3, 3) of vectors (n, 3) and (n, 3)."""
        return self.mean((a[:, :, None] * b[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)

    def covariances(self, a: Array, b: Array) -> Array:
        """Return the covariances (n, 3, 3) of vectors (n, 3) and (n, 3)."""
        mean_a, mean_b = self.mean(a), self.mean(b)
        return np.asarray(self.moments(a, b) - mean_a[:, :, None] * mean_b[:, None, :])


def estimate_normals(points: Array, outward: Array | None = None) -> Array:
    """Estimate unit normals (n, 3) of points (n, 3), one per voxel.

    Without ``outward``, the viewpoint is unknown. Fruit and stems bulge towards the viewer, so the bulging pieces
    together show from which side a cloud was seen, and each piece weakly shows its own outer side; neighboring pieces
    are then smoothed. On rods such as stems, normals are made perpendicular to the axis and point away from the local
    centroid, which is right for both one-sided and all-round views.

    Args:
        points: (n, 3) metres.
        outward: (n, 3) wrong normals that on average over a neighborhood still show the outer side, or None.
    """
    if len(points) < 3:
        return np.tile([-1.0, 0.0, 0.0], (len(points), 1))
    bare = Cloud(points, np.zeros_like(points), np.zeros_like(points))
    cloud = to_open3d(bare)
    cloud.estimate_normals(open3d().geometry.KDTreeSearchParamHybrid(_REACH, _MAX_NEIGHBORS))
    normals = np.array(cloud.normals)
    sides = _outward(bare) if outward is None else _smoothed(points, outward)
    inwards = (sides * normals).sum(axis=1) < 0
    normals[inwards] *= -1.0
    cells, cell = voxel_means(bare, _ROD_CELL)
    near = Neighborhoods(cells.points, _ROD_REACH)
    variances, axes = np.linalg.eigh(near.covariances(cells.points, cells.points))
    on_rod = (variances[:, 2] > _ROD_ELONGATION * variances[:, 1])[cell]
    axis, out = axes[cell[on_rod], :, 2], points[on_rod] - near.mean(cells.points)[cell[on_rod]]
    rods = normals[on_rod]
    rods -= (rods * axis).sum(axis=1, keepdims=True) * axis
    rods *= np.where((rods * out).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    normals[on_rod] = rods / np.maximum(np.linalg.norm(rods, axis=1, keepdims=True), 1e-9)
    return normals


def mend_normals(whole: Cloud, thin: Cloud) -> tuple[Cloud, Cloud]:
    """Return a cloud and its points per voxel with normals estimated from these, on the side of the given ones."""
    normals = estimate_normals(thin.points, thin.normals)
    nearest = cKDTree(thin.points).query(whole.points)[1]
    return replace(whole, normals=normals[nearest]), replace(thin, normals=normals)


def _outward(bare: Cloud) -> Array:
    """Return vectors (n, 3) that point roughly out of the surfaces."""
    cells, cell = voxel_means(bare, _PIECE)
    near = Neighborhoods(cells.points, _AROUND)
    axes = np.linalg.eigh(near.covariances(cells.points, cells.points))[1][:, :, 0]
    bulge = ((cells.points - near.mean(cells.points)) * axes).sum(axis=1)
    clear = np.abs(bulge) > _CLEAR_BULGE
    side = (np.sign(bulge[clear])[:, None] * axes[clear]).sum(axis=0) / max(np.count_nonzero(clear), 1)
    length = float(np.linalg.norm(side))
    view = side / length if length > _ONE_SIDED else _DEFAULT_VIEW
    out = (axes @ view + np.clip(bulge, -_BULGE / 2, _BULGE / 2) / _BULGE)[:, None] * axes
    for _ in range(_ROUNDS):
        out = near.mean(out)
    return np.asarray(out[cell])


def _smoothed(points: Array, vectors: Array) -> Array:
    """Return the means of vectors (n, 3) over the neighborhoods of points (n, 3)."""
    cells, cell = voxel_means(Cloud(points, np.zeros_like(points), vectors), _PIECE)
    return np.asarray(Neighborhoods(cells.points, _AROUND).mean(cells.normals)[cell])
