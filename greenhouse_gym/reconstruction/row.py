"""From a recording to one cloud of the row: register, optimize, merge, remove outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.clouds import Cloud, merge, to_open3d, voxel_means
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.track import RegisteredStations, RowReport, register_stations


@dataclass(frozen=True, eq=False)
class RowCloud(Cloud):
    """A row as one cloud, in the frame of its first registered station (metres; z up, y along the row).

    Attributes:
        station: (n,) number of the station a point was first seen from.
        registered: (stations,) bool.
        world_from_station: (stations, 4, 4); NaN where not registered, identity for the first that is.
        report: What happened on the way.
    """

    station: npt.NDArray[np.int32]
    registered: npt.NDArray[np.bool_]
    world_from_station: Array
    report: RowReport


def reconstruct_row(
    recording: Recording,
    settings: ReconstructionSettings | None = None,
    on_station: Callable[[int], None] | None = None,
) -> RowCloud:
    """Turn a recording into one metric cloud of the row, as the paper does.

    60 cm foreground, silhouettes shifted to the least difference, mean XYZ offset, ICP; a station that cannot be
    registered is skipped and the next tried against the last good one; merge of all cameras; radius outlier removal.
    Beyond the paper, stations two steps apart are registered as well and the pose graph is optimized.

    Args:
        recording: The recording; its stations are read one at a time.
        settings: All settings; the paper's values by default.
        on_station: Called with the number of each station when it is done (for progress bars).

    Raises:
        ReconstructionError: Fewer than two stations could be registered; the message gives the reasons.
    """
    settings = settings or ReconstructionSettings()
    stations = register_stations(recording, settings, on_station)
    started = perf_counter()
    merged = merge_stations(stations, settings)
    merged_at = perf_counter()
    row = remove_outliers(merged, settings)
    seconds = row.report.seconds | {"merge": merged_at - started, "outliers": perf_counter() - merged_at}
    return replace(row, report=replace(row.report, seconds=seconds))


def merge_stations(stations: RegisteredStations, settings: ReconstructionSettings) -> RowCloud:
    """All registered stations in one frame, one point per voxel."""
    clouds, numbers = [], []
    for i in np.flatnonzero(stations.registered):
        cloud = stations.clouds[i]
        if cloud is not None:
            clouds.append(cloud.moved(stations.world_from_station[i]))
            numbers.append(np.full(len(cloud), i, dtype=np.int32))
    thin, voxel = voxel_means(merge(clouds), settings.voxel)
    first_seen = np.full(len(thin), len(stations.registered), dtype=np.int32)
    np.minimum.at(first_seen, voxel, np.concatenate(numbers))
    report = replace(stations.report, merged_points=len(thin), points=len(thin))
    return RowCloud(
        thin.points, thin.colors, thin.normals, first_seen, stations.registered, stations.world_from_station, report
    )


def remove_outliers(row: RowCloud, settings: ReconstructionSettings) -> RowCloud:
    """Radius outlier removal: points with few neighbours are what did not overlap."""
    if not len(row):
        return row
    kept: Any = to_open3d(row).remove_radius_outlier(settings.outlier_neighbours, settings.outlier_radius)[1]
    rows = np.sort(np.asarray(kept, dtype=np.int64))
    return replace(
        row, points=row.points[rows], colors=row.colors[rows], normals=row.normals[rows], station=row.station[rows],
        report=replace(row.report, points=len(rows)),
    )  # fmt: skip
