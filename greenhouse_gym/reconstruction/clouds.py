"""Clouds of points with colors and normals, and the passage to and from Open3D."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction.normals import image_normals
from greenhouse_gym.reconstruction.settings import ReconstructionSettings


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with colors and normals.

    Attributes:
        points: (n, 3) metres.
        colors: (n, 3) RGB in [0, 1].
        normals: (n, 3) unit vectors, toward the cameras.
    """

    points: Array
    colors: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: npt.NDArray[np.generic]) -> Cloud:
        """The points at ``rows``: indices or a mask."""
        return Cloud(self.points[rows], self.colors[rows], self.normals[rows])

    def moved(self, target_from_source: Array) -> Cloud:
        """The cloud expressed in another frame."""
        return Cloud(
            transform(target_from_source, self.points), self.colors, self.normals @ target_from_source[:3, :3].T
        )


def to_open3d(cloud: Cloud) -> Any:
    """A cloud as Open3D's legacy point cloud."""
    o3d = open3d()
    result = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    result.colors = o3d.utility.Vector3dVector(cloud.colors)
    result.normals = o3d.utility.Vector3dVector(cloud.normals)
    return result


def from_open3d(cloud: Any) -> Cloud:
    """A cloud from Open3D's legacy point cloud; averaged normals get unit length again."""
    normals = np.array(cloud.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Cloud(np.array(cloud.points), np.array(cloud.colors), normals)


def thin_out(cloud: Cloud, voxel: float) -> Cloud:
    """One point per cube of ``voxel`` metres: the mean of what lies in it."""
    return from_open3d(to_open3d(cloud).voxel_down_sample(voxel)) if len(cloud) else cloud


def camera_cloud(frame: RgbdFrame, name: str, rig: Rig, settings: ReconstructionSettings, bias: float = 0.0) -> Cloud:
    """What one camera of a station sees of the foreground, in the rig frame.

    The cut is along the rig's forward axis from the reference camera, so that the turned cameras keep the same slab
    of the row as the middle one.

    Args:
        frame: The camera's image.
        name: The camera.
        rig: The rig.
        settings: All settings.
        bias: Relative depth error of the camera; depths are divided by (1 + bias).
    """
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + settings.foreground
    rig_from_camera = rig.cameras[name].rig_from_camera
    rows, columns = frame.pixels(frame.depth < 2.0 * settings.foreground)
    points = transform(rig_from_camera, frame.back_project(rows, columns) / (1.0 + bias))
    kept = points[:, 0] < front
    rows, columns = rows[kept], columns[kept]
    mask = np.zeros(frame.depth.shape, dtype=bool)
    mask[rows, columns] = True
    normals = image_normals(frame, mask, settings.normal_window) @ rig_from_camera[:3, :3].T
    return Cloud(points[kept], frame.color[rows, columns] / 255.0, normals)


def station_cloud(
    station: Station, rig: Rig, settings: ReconstructionSettings, bias: Mapping[str, float] | None = None
) -> Cloud:
    """What all cameras of a station see of the foreground, in the rig frame, one point per voxel of the merged row."""
    bias = bias or {}
    parts = [camera_cloud(frame, name, rig, settings, bias.get(name, 0.0)) for name, frame in station.frames.items()]
    return thin_out(merge(parts), settings.voxel)


def voxel_means(cloud: Cloud, voxel: float) -> tuple[Cloud, npt.NDArray[np.int64]]:
    """The mean point of each occupied cube of ``voxel`` metres, and the cube's number for each point, (n,)."""
    cubes = np.floor((cloud.points - cloud.points.min(axis=0)) / voxel).astype(np.int64)
    extent = cubes.max(axis=0) + 1
    keys = (cubes[:, 0] * extent[1] + cubes[:, 1]) * extent[2] + cubes[:, 2]
    _, cube, count = np.unique(keys, return_inverse=True, return_counts=True)

    def mean(values: Array) -> Array:
        return np.column_stack([np.bincount(cube, values[:, k]) for k in range(3)]) / count[:, None]

    normals = mean(cloud.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Cloud(mean(cloud.points), mean(cloud.colors), normals), cube


def merge(clouds: list[Cloud]) -> Cloud:
    """Clouds of one frame as one."""
    if not clouds:
        return Cloud(*np.zeros((3, 0, 3)))
    return Cloud(
        np.concatenate([c.points for c in clouds]),
        np.concatenate([c.colors for c in clouds]),
        np.concatenate([c.normals for c in clouds]),
    )
