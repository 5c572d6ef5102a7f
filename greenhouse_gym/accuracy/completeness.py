"""Completeness: the fraction of the visible surface that a cloud contains."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Intrinsics, Rig
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.geometry import Array, transform

_FOREGROUND = 0.60  # m, the usual cut
_VOXEL = 0.004  # m, side of the cubes that get one point each
_SKIP = 2  # pixels between rays in either direction
_WITHIN = 0.005  # m


def visible_surface(truth: PlantRow, rig: Rig, world_from_station: Array) -> Array:
    """Return points (n, 3) in the world, evenly spread over the true surface that a recording could show.

    Every camera views the true row without noise. Surface within the cut along the rig's forward axis from the
    reference camera counts, once regardless of the number of cameras that see it.

    Args:
        truth: The grown row.
        rig: The cameras.
        world_from_station: (stations, 4, 4) true poses.
    """
    caster = RowRaycaster.of(truth)
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + _FOREGROUND
    stations = []
    for pose in world_from_station:
        seen = []
        for camera in rig.cameras.values():
            intrinsics = _every(camera.intrinsics, _SKIP)
            view = caster.render(pose @ camera.rig_from_camera, intrinsics)
            frame = RgbdFrame(view.color, np.where(np.isfinite(view.depth), view.depth, 0), intrinsics)
            in_rig = transform(camera.rig_from_camera, frame.points())
            seen.append(transform(pose, in_rig[in_rig[:, 0] < front]))
        stations.append(_one_per_cube(np.concatenate(seen), _VOXEL))
    return _one_per_cube(np.concatenate(stations), _VOXEL)


def completeness(points: Array, surface: Array) -> float:
    """Return the fraction of surface points (n, 3) with a cloud point (k, 3) within 5 mm, in the same frame."""
    distance, _ = cKDTree(points).query(surface, distance_upper_bound=_WITHIN)
    return float(np.isfinite(distance).mean())


def _every(k: Intrinsics, skip: int) -> Intrinsics:
    """Return the camera with one pixel for every ``skip`` x ``skip`` pixels."""
    return Intrinsics(
        k.width // skip,
        k.height // skip,
        k.fx / skip,
        k.fy / skip,
        (k.cx + 0.5) / skip - 0.5,
        (k.cy + 0.5) / skip - 0.5,
    )


def _one_per_cube(points: Array, size: float) -> Array:
    """Return the first point in each occupied cube of the world's grid."""
    cubes = np.floor(points / size).astype(np.int64) + (1 << 20)
    keys = (cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]
