"""Merging of registered stations into one cloud with one point per voxel, and detection of outliers.

The row is processed in slices along y, so memory is that of the result and of one slice.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.common.extras import needs
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.geometry.point_clouds import Cloud, PackedCloud, merge, voxel_means, voxels
from greenhouse_gym.reconstruction.icp import SEE_THROUGH
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import BLOCK, MinDepth

with needs("reconstruct"):
    from threadpoolctl import threadpool_limits

_SLICE = 0.5  # m along the row
_RADIUS = 0.006  # m around a point within which other points support it
_MIN_NEIGHBORS = 2  # points within that radius
_MIN_OBSERVERS = 2  # stations with a point nearby where others see through
_MIN_CONTRADICTING = 2  # stations that must see through a point to remove it


@dataclass(frozen=True, eq=False)
class MergedStations:
    """Cloud of all stations, one point per voxel."""

    cloud: Cloud  # one point per voxel
    station: npt.NDArray[np.int32]  # (n,) number of the station that observed each point first
    observers: npt.NDArray[np.int32]  # (n,) number of stations with a point within about the outlier radius
    isolated: npt.NDArray[np.bool_]  # (n,) bool, too few neighbors within the outlier radius


def merge_stations(
    clouds: Mapping[int, PackedCloud], world_from_station: Array, settings: ReconstructionSettings
) -> MergedStations:
    """Merge the clouds of all stations, each in its rig frame, into one point per voxel, the mean of all in it."""
    along = {
        i: cloud.points @ world_from_station[i, 1, :3].astype(np.float32) + np.float32(world_from_station[i, 1, 3])
        for i, cloud in clouds.items()
        if len(cloud.points)
    }
    spans = {i: (float(y.min()), float(y.max())) for i, y in along.items()}
    low, high = np.floor(min(span[0] for span in spans.values())), np.ceil(max(span[1] for span in spans.values()))
    margin = 2 * _RADIUS

    def merge_slice(start: float) -> MergedStations:
        end = start + _SLICE
        pieces, numbers = [merge([])], [np.zeros(0, dtype=np.int32)]
        for i, span in spans.items():
            if span[0] < end + margin and span[1] >= start - margin:
                here = (along[i] >= start - margin) & (along[i] < end + margin)
                pieces.append(clouds[i].select(here).transformed(world_from_station[i]))
                numbers.append(np.full(len(pieces[-1]), i, dtype=np.int32))
        merged = _merge_points(merge(pieces), np.concatenate(numbers), settings.voxel)
        y = merged.cloud.points[:, 1]
        rows = (y >= start) & (y < end)
        return MergedStations(
            merged.cloud.select(rows), merged.station[rows], merged.observers[rows], merged.isolated[rows]
        )

    # numpy and the search tree release the interpreter's lock
    with ThreadPoolExecutor(2) as pool, threadpool_limits(1, "blas"):
        parts = list(pool.map(merge_slice, np.arange(low, high, _SLICE)))
    arrays = (np.concatenate([getattr(part, name) for part in parts]) for name in ("station", "observers", "isolated"))
    return MergedStations(merge([part.cloud for part in parts]), *arrays)


def _merge_points(cloud: Cloud, station: npt.NDArray[np.int32], voxel: float) -> MergedStations:
    means, row = voxel_means(cloud, voxel)
    first = np.full(len(means), np.iinfo(np.int32).max, dtype=np.int32)
    np.minimum.at(first, row, station)
    observers = np.zeros(len(means), dtype=np.int32)
    stations = int(station.max(initial=0)) + 1
    for offset in (0.0, 0.5):  # two grids, so that no neighbor is missed across a cube's face
        cube = voxels(cloud.points, 1.5 * _RADIUS, offset)
        cubes, count = np.unique(np.unique(cube * stations + station) // stations, return_counts=True)
        np.maximum.at(observers, row, count[np.searchsorted(cubes, cube)].astype(np.int32))
    return MergedStations(means, first, observers, _isolated_points(means.points))


def _isolated_points(points: Array) -> npt.NDArray[np.bool_]:
    """Mask points (n, 3) with too few neighbors; only those in thinly filled cubes are searched."""
    isolated = np.zeros(len(points), dtype=bool)
    cubes, count = np.unique(voxels(points, _RADIUS), return_inverse=True, return_counts=True)[1:]
    thin = np.flatnonzero(count[cubes] <= _MIN_NEIGHBORS)
    neighbors = cKDTree(points).query_ball_point(points[thin], _RADIUS, return_length=True)
    isolated[thin[neighbors <= _MIN_NEIGHBORS]] = True  # a point is its own neighbor
    return isolated


def find_outliers(
    merged: MergedStations,
    world_from_station: Array,
    min_depths: Mapping[int, Mapping[str, MinDepth]],
    rig: Rig,
    settings: ReconstructionSettings,
) -> npt.NDArray[np.bool_]:
    """Mask points (n,) with too few neighbors, or observed by few stations while others see through them.

    The second is the purpose of the paper's radius outlier removal: it removes the points of a wrongly registered
    station, and of what was in front of the cameras for a moment. Points that are hidden from the other stations, or in
    view of one station only, as at the row's ends, are kept. ``world_from_station`` (stations, 4, 4) is NaN where not
    registered.
    """
    result = merged.isolated.copy()
    doubtful = np.flatnonzero(~result & (merged.observers < _MIN_OBSERVERS))
    points = merged.cloud.points[doubtful]
    contradicting = np.zeros(len(points), dtype=np.int64)
    for i in np.flatnonzero(np.isfinite(world_from_station[:, 0, 0])):
        near = np.flatnonzero(np.abs(points[:, 1] - world_from_station[i, 1, 3]) < 2 * settings.foreground)
        in_rig = transform(invert(world_from_station[i]), points[near])
        through = np.zeros(len(near), dtype=bool)
        for name, depth in min_depths[int(i)].items():
            camera = rig.cameras[name]
            in_camera = transform(invert(camera.rig_from_camera), in_rig)
            row, v, u = camera.intrinsics.project(in_camera)
            through[row] |= depth[v // BLOCK, u // BLOCK] / 1e3 > in_camera[row, 2] + SEE_THROUGH
        contradicting[near[through]] += 1
    result[doubtful[contradicting >= _MIN_CONTRADICTING]] = True
    return result
