"""Completeness: the fraction of the visible surface that a cloud contains."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Intrinsics, Rig
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.geometry import Array, transform


def visible_surface(
    truth: PlantRow,
    rig: Rig,
    world_from_station: Array,
    foreground: float = 0.60,
    voxel: float = 0.004,
    skip: int = 2,
) -> Array:
    """Return points (n, 3) in the world, evenly spread over the true surface that a recording could show.

    Every camera views the true row without noise. Surface within the cut along the rig's forward axis from the
    reference camera counts, once regardless of the number of cameras that see it.

    Args:
        truth: The grown row.
        rig: The cameras.
        world_from_station: (stations, 4, 4) true poses.
        foreground: The cut, metres.
        voxel: One point per cube of this size, metres.
        skip: Distance between rays in either direction, pixels.
    """
    caster = RowRaycaster.of(truth)
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + foreground
    stations = []
    for pose in world_from_station:
        seen = []
        for camera in rig.cameras.values():
            intrinsics = _every(camera.intrinsics, skip)
            view = caster.render(pose @ camera.rig_from_camera, intrinsics)
            frame = RgbdFrame(view.color, np.where(np.isfinite(view.depth), view.depth, 0), intrinsics)
            in_rig = transform(camera.rig_from_camera, frame.points())
            seen.append(transform(pose, in_rig[in_rig[:, 0] < front]))
        stations.append(_one_per_cube(np.concatenate(seen), voxel))
    return _one_per_cube(np.concatenate(stations), voxel)


def completeness(points: Array, surface: Array, within: float = 0.005) -> float:
    """Return the fraction of surface points (n, 3) with a cloud point (k, 3) ``within`` metres, in the same frame."""
    distance, _ = cKDTree(points).query(surface, distance_upper_bound=within)
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
