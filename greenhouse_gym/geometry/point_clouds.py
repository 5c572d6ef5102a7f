"""Point clouds with colors and normals, voxel means, and conversion to Open3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, transform

_BLACK, _BURNT = 0.03, 0.97  # bounds of all channels beyond which a color holds no information
_MAX_FAILED = 0.9  # fraction of the points beyond these bounds
_MAX_CELLS = 4000  # cells in each direction that are distinguished; what is farther off falls into the last one


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with colors and normals."""

    points: Array  # (n, 3) metres
    colors: Array  # (n, 3) RGB in [0, 1]
    normals: Array  # (n, 3) unit vectors, toward the cameras

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: npt.NDArray[np.generic]) -> Cloud:
        """Return the points at ``rows``: indices or a mask."""
        return Cloud(self.points[rows], self.colors[rows], self.normals[rows])

    def transformed(self, target_from_source: Array) -> Cloud:
        """Return the cloud expressed in another frame."""
        normals = self.normals @ target_from_source[:3, :3].T
        return Cloud(transform(target_from_source, self.points), self.colors, normals)


def to_open3d(cloud: Cloud) -> Any:
    """Convert a cloud to Open3D's legacy point cloud."""
    o3d = open3d()
    result = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    result.colors = o3d.utility.Vector3dVector(cloud.colors)
    result.normals = o3d.utility.Vector3dVector(cloud.normals)
    return result


@dataclass(frozen=True, eq=False)
class PackedCloud:
    """A cloud in 18 bytes per point: ``points`` float32, ``colors`` uint8, ``normals`` int8 (1/127), (n, 3) each."""

    points: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]
    normals: npt.NDArray[np.int8]

    def select(self, rows: npt.NDArray[np.generic]) -> PackedCloud:
        """Return the points at ``rows``: indices or a mask."""
        return PackedCloud(self.points[rows], self.colors[rows], self.normals[rows])

    def transformed(self, target_from_source: Array) -> Cloud:
        """Return the cloud in double precision, expressed in another frame."""
        normals = self.normals / 127.0
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return Cloud(self.points.astype(np.float64), self.colors / 255.0, normals).transformed(target_from_source)


def voxels(points: Array, size: float, offset: float = 0.0) -> npt.NDArray[np.int64]:
    """Return the index of each point's voxel (n,) for points (n, 3); ``offset`` shifts the grid, in voxels."""
    cubes = np.floor(points / size + offset).astype(np.int64)
    cubes -= cubes.min(axis=0, initial=0)
    extent = cubes.max(axis=0, initial=0) + 1
    return np.asarray((cubes[:, 0] * extent[1] + cubes[:, 1]) * extent[2] + cubes[:, 2])


def means_by_voxel(points: Array, voxel: float, *values: Array) -> tuple[list[Array], npt.NDArray[np.int64]]:
    """Average values (n, 3) of the points in each occupied cube; also return the row of each point's mean (n,)."""
    _, cube, count = np.unique(voxels(points, voxel), return_inverse=True, return_counts=True)
    return [
        np.column_stack([np.bincount(cube, each[:, k], len(count)) for k in range(3)]) / count[:, None]
        for each in values
    ], cube


def voxel_means(cloud: Cloud, voxel: float) -> tuple[Cloud, npt.NDArray[np.int64]]:
    """Average the points in each occupied cube of ``voxel`` metres; also return the row of each point's mean (n,)."""
    (points, colors, normals), cube = means_by_voxel(cloud.points, voxel, cloud.points, cloud.colors, cloud.normals)
    return Cloud(points, colors, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)), cube


def group_sizes(points: Array, cell: float) -> npt.NDArray[np.int64]:
    """Return for each point (n, 3) the number of points in its group: those in connected cubes of ``cell`` metres."""
    with np.errstate(over="ignore"):
        offsets = np.floor((points - np.median(points, axis=0)) / cell)
    cubes = np.clip(offsets, -_MAX_CELLS, _MAX_CELLS).astype(np.int64) + _MAX_CELLS
    base = [1, 4 * _MAX_CELLS, 16 * _MAX_CELLS**2]
    cells, index = np.unique(cubes @ base, return_inverse=True)
    corners = np.stack([cells % base[1], cells // base[1] % base[1], cells // base[2]], axis=1)
    pairs = cKDTree(corners).query_pairs(1.8, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(cells),) * 2)
    group = connected_components(links, directed=False)[1][index.ravel()]
    return np.bincount(group)[group]


def merge(clouds: Sequence[Cloud]) -> Cloud:
    """Concatenate clouds of one frame."""
    if not clouds:
        return Cloud(*np.zeros((3, 0, 3)))
    return Cloud(*(np.concatenate([getattr(c, name) for c in clouds]) for name in ("points", "colors", "normals")))


def exposure_failure(colors: npt.NDArray[np.floating]) -> str:
    """Return a phrase on the wrong exposure of photographs with colors (n, 3), from 0 to 1, or ""."""
    if not len(colors):
        return ""
    black, burnt = (colors < _BLACK).all(axis=1).mean(), (colors > _BURNT).all(axis=1).mean()
    if black > _MAX_FAILED:
        return f"{black:.0%} of the points are black: the photographs are underexposed"
    if burnt > _MAX_FAILED:
        return f"{burnt:.0%} of the points are burnt out to white: the photographs are overexposed"
    return ""
