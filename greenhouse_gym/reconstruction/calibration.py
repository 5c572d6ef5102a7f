"""Relative depth error of each camera, from the surfaces that several cameras of a station see.

A stereo camera reports (1 + bias) times the depth. The cameras' axes cross in the plants, so two cameras see the same
surface from different sides; the gap between what they report, along the surface's normal, is linear in their biases.
A bias common to all cameras scales everything alike and cannot be seen this way.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.capture.frames import Station
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.clouds import Cloud, camera_cloud, thin_out
from greenhouse_gym.reconstruction.settings import ReconstructionSettings


def estimate_bias(recording: Recording, settings: ReconstructionSettings) -> dict[str, float]:
    """Relative depth error of each camera, by name; they add up to zero.

    Looks at ``settings.calibration_stations`` stations spread over the recording; those without shared surfaces add
    nothing. Zero for every camera where nothing is shared at all, or with a single camera.
    """
    names = list(recording.rig.cameras)
    bias = dict.fromkeys(names, 0.0)
    if len(names) < 2 or settings.calibration_stations < 1 or len(recording) == 0:
        return bias
    chosen = np.unique(np.linspace(0, len(recording) - 1, settings.calibration_stations).round().astype(int))
    clouds = [_clouds(recording[int(i)], recording.rig, settings) for i in chosen]
    for _ in range(3):  # the pairs of points change a little with the biases
        step = _solve(clouds, recording.rig, bias, settings)
        bias = {name: bias[name] + step[k] for k, name in enumerate(names)}
    return {name: round(value, 9) for name, value in bias.items()}


def _clouds(station: Station, rig: Rig, settings: ReconstructionSettings) -> dict[str, Cloud]:
    return {
        name: thin_out(camera_cloud(frame, name, rig, settings), 2 * settings.voxel)
        for name, frame in station.frames.items()
    }


def _solve(
    stations: list[dict[str, Cloud]], rig: Rig, bias: Mapping[str, float], settings: ReconstructionSettings
) -> Array:
    """The change of the biases, (cameras,), that closes the gaps best in the least-squares sense."""
    names = list(rig.cameras)
    normal_matrix = np.ones((len(names), len(names)))  # the biases add up to zero
    right = np.zeros(len(names))
    for clouds in stations:
        moved = {name: _corrected(cloud, rig, name, bias[name]) for name, cloud in clouds.items() if len(cloud) > 50}
        for one, two in permutations(moved, 2):
            a, b = moved[one], moved[two]
            distance, row = cKDTree(b.points).query(a.points, distance_upper_bound=settings.fine_distance)
            found = np.isfinite(distance)
            source, target = a.select(found), b.select(row[found])
            facing = (source.normals * target.normals).sum(axis=1) > 0.9
            source, target = source.select(facing), target.select(facing)
            gap = ((source.points - target.points) * target.normals).sum(axis=1)
            # a larger bias of camera `one` moves its points outwards along its rays, and likewise for `two`
            jacobian = np.zeros((len(gap), len(names)))
            for name, cloud, sign in ((one, source, -1.0), (two, target, 1.0)):
                rays = cloud.points - rig.cameras[name].rig_from_camera[:3, 3]
                jacobian[:, names.index(name)] = sign * (rays * target.normals).sum(axis=1)
            weight = np.clip(1 - (gap / settings.fine_distance) ** 2, 0, None) ** 2
            normal_matrix += jacobian.T @ (weight[:, None] * jacobian)
            right -= jacobian.T @ (weight * gap)
    solution = np.linalg.lstsq(normal_matrix, right, rcond=1e-9)[0]
    return np.asarray(solution - solution.mean())


def _corrected(cloud: Cloud, rig: Rig, name: str, bias: float) -> Cloud:
    """A camera's cloud with its depths divided by (1 + bias)."""
    origin = rig.cameras[name].rig_from_camera[:3, 3]
    return Cloud(origin + (cloud.points - origin) / (1.0 + bias), cloud.colors, cloud.normals)
