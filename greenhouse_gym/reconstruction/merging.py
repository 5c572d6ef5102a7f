"""Registered stations as one cloud: one point per voxel, and which of them did not overlap.

The row is worked through in slices along y, so memory is that of the result and of one slice.
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
from greenhouse_gym.reconstruction.point_clouds import Cloud, PackedCloud, merge, voxel_means, voxels
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import BLOCK, Screen

with needs("reconstruct"):
    from threadpoolctl import threadpool_limits

_SLICE = 0.5  # m along the row


@dataclass(frozen=True, eq=False)
class Merged:
    """Stations merged.

    Attributes:
        cloud: One point per voxel.
        station: (n,) number of the station each point was first seen from.
        seen_by: (n,) number of stations that saw something within about the outlier radius.
        lonely: (n,) bool, fewer neighbors within the outlier radius than wanted.
    """

    cloud: Cloud
    station: npt.NDArray[np.int32]
    seen_by: npt.NDArray[np.int32]
    lonely: npt.NDArray[np.bool_]


def merge_stations(
    clouds: Mapping[int, PackedCloud], world_from_station: Array, settings: ReconstructionSettings
) -> Merged:
    """All stations in one frame, one point per voxel: the mean of what all of them measured in it.

    Args:
        clouds: By the number of the station, in its rig frame.
        world_from_station: (stations, 4, 4).
        settings: All settings.
    """
    along = {
        i: cloud.points @ world_from_station[i, 1, :3].astype(np.float32) + np.float32(world_from_station[i, 1, 3])
        for i, cloud in clouds.items()
        if len(cloud.points)
    }
    spans = {i: (float(y.min()), float(y.max())) for i, y in along.items()}
    low, high = (edge(f(s[k] for s in spans.values())) for k, edge, f in ((0, np.floor, min), (1, np.ceil, max)))
    margin = 2 * settings.outlier_radius

    def merge_slice(start: float) -> Merged:
        end = start + _SLICE
        pieces, numbers = [merge([])], [np.zeros(0, dtype=np.int32)]
        for i, span in spans.items():
            if span[0] < end + margin and span[1] >= start - margin:
                here = (along[i] >= start - margin) & (along[i] < end + margin)
                pieces.append(clouds[i].select(here).moved(world_from_station[i]))
                numbers.append(np.full(len(pieces[-1]), i, dtype=np.int32))
        merged = _merge_points(merge(pieces), np.concatenate(numbers), settings)
        y = merged.cloud.points[:, 1]
        return _select(merged, (y >= start) & (y < end))

    # numpy and the search tree let go of the interpreter's lock
    with ThreadPoolExecutor(2) as pool, threadpool_limits(1, "blas"):
        parts = list(pool.map(merge_slice, np.arange(low, high, _SLICE)))
    return Merged(
        merge([part.cloud for part in parts]),
        np.concatenate([part.station for part in parts]),
        np.concatenate([part.seen_by for part in parts]),
        np.concatenate([part.lonely for part in parts]),
    )


def _merge_points(cloud: Cloud, station: npt.NDArray[np.int32], settings: ReconstructionSettings) -> Merged:
    means, row = voxel_means(cloud, settings.voxel)
    first_seen = np.full(len(means), np.iinfo(np.int32).max, dtype=np.int32)
    np.minimum.at(first_seen, row, station)
    seen_by = np.zeros(len(means), dtype=np.int32)
    stations = int(station.max(initial=0)) + 1
    for offset in (0.0, 0.5):  # two grids, so that no neighbor is missed for lying across a cube's face
        cube = voxels(cloud.points, 1.5 * settings.outlier_radius, offset)
        cubes, count = np.unique(np.unique(cube * stations + station) // stations, return_counts=True)
        np.maximum.at(seen_by, row, count[np.searchsorted(cubes, cube)].astype(np.int32))
    return Merged(means, first_seen, seen_by, lonely_points(means.points, settings))


def lonely_points(points: Array, settings: ReconstructionSettings) -> npt.NDArray[np.bool_]:
    """Points (n,) with too few neighbors; only those in thinly filled cubes are looked at closely."""
    lonely = np.zeros(len(points), dtype=bool)
    cubes, count = np.unique(voxels(points, settings.outlier_radius), return_inverse=True, return_counts=True)[1:]
    thin = np.flatnonzero(count[cubes] <= settings.outlier_neighbours)
    neighbors = cKDTree(points).query_ball_point(points[thin], settings.outlier_radius, return_length=True)
    lonely[thin[neighbors <= settings.outlier_neighbours]] = True  # a point is its own neighbor
    return lonely


def _select(merged: Merged, rows: npt.NDArray[np.bool_]) -> Merged:
    return Merged(merged.cloud.select(rows), merged.station[rows], merged.seen_by[rows], merged.lonely[rows])


def outliers(
    merged: Merged,
    world_from_station: Array,
    screens: Mapping[int, Mapping[str, Screen]],
    rig: Rig,
    settings: ReconstructionSettings,
) -> npt.NDArray[np.bool_]:
    """Points (n,) that do not overlap: too few neighbors, or seen by few stations while others see through the place.

    The second is what the paper's radius outlier removal is after: it takes away what a wrongly registered station
    brought, and what was in front of the cameras for a moment. What others could not see, or only one station looked
    at, as at the row's ends, is spared.

    Args:
        merged: The stations merged.
        world_from_station: (stations, 4, 4); NaN where not registered.
        screens: What each station's cameras did not see through.
        rig: The cameras.
        settings: All settings.
    """
    result = merged.lonely.copy()
    doubtful = np.flatnonzero(~result & (merged.seen_by < settings.outlier_stations))
    points = merged.cloud.points[doubtful]
    seen_through = np.zeros(len(points), dtype=np.int64)
    for i in np.flatnonzero(np.isfinite(world_from_station[:, 0, 0])):
        near = np.flatnonzero(np.abs(points[:, 1] - world_from_station[i, 1, 3]) < 2 * settings.foreground)
        in_rig = transform(invert(world_from_station[i]), points[near])
        through = np.zeros(len(near), dtype=bool)
        for name, screen in screens[int(i)].items():
            camera = rig.cameras[name]
            in_camera = transform(invert(camera.rig_from_camera), in_rig)
            row, v, u = camera.intrinsics.project(in_camera)
            through[row] |= screen[v // BLOCK, u // BLOCK] / 1e3 > in_camera[row, 2] + settings.see_through
        seen_through[near[through]] += 1
    result[doubtful[seen_through >= settings.outlier_views]] = True
    return result
