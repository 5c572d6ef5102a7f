"""Reconstruction of a recording as one cloud of the row: register, optimize, merge, remove outliers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.common.extras import needs
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.geometry.point_clouds import Cloud, PackedCloud, exposure_failure, merge, voxel_means, voxels
from greenhouse_gym.reconstruction.icp import SEE_THROUGH
from greenhouse_gym.reconstruction.pose_graph import optimize_poses
from greenhouse_gym.reconstruction.report import RowReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings, settings_for
from greenhouse_gym.reconstruction.station_registration import RegisteredStations, register_stations
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


@dataclass(frozen=True, eq=False)
class ObservedSpace:
    """Depth images of the registered stations, reduced to the data for occupancy carving."""

    rig: Rig  # the calibrated cameras
    min_depths: Mapping[int, Mapping[str, MinDepth]]  # by station and camera


@dataclass(frozen=True, eq=False)
class RowCloud(Cloud):
    """A row as one cloud, in the frame of its first registered station (metres; z up, y along the row).

    Attributes:
        station: (n,) number of the station that observed a point first.
        registered: (stations,) bool.
        world_from_station: (stations, 4, 4); NaN where not registered, identity for the first that is.
        report: Report of the reconstruction.
        observed: The space that the stations observed; None for a cloud that was read from a file.
    """

    station: npt.NDArray[np.int32]
    registered: npt.NDArray[np.bool_]
    world_from_station: Array
    report: RowReport
    observed: ObservedSpace | None = None


def reconstruct_row(
    recording: Recording,
    settings: ReconstructionSettings | None = None,
    on_station: Callable[[int], None] | None = None,
    folder: str | Path | None = None,
    poses: str | None = None,
) -> RowCloud:
    """Turn a recording into one metric cloud of the row, by the paper's steps and a few more.

    60 cm foreground, silhouettes shifted to the least difference, mean XYZ offset, ICP; a station that cannot be
    registered is skipped and the next one registered to the last good one; merge of all cameras; removal of points that
    few stations observed. In addition to the paper, the cameras are calibrated from their overlap, stations two and
    three steps apart are registered as well, and the pose graph is optimized.

    Where the row splits into segments that cannot be registered to each other, this is the one with the most stations,
    and the report names the others; `reconstruct_segments` returns all.

    Args:
        recording: The recording; its stations are read one at a time.
        settings: All settings; fitted to the recording by default, see `settings_for`.
        on_station: Called with the number of each station when it is done (for progress bars).
        folder: Folder of the journal from which an interrupted reconstruction resumes.
        poses: "estimate" the poses of the stations; "given" uses the recording's, for rigs on rails and cameras on
            arms; "refine" corrects those by the images. By default that of the settings.

    Raises:
        UnknownNameError: ``poses`` is not a known choice.
        ReconstructionError: Too few stations could be registered; the message gives the reasons.
    """
    settings = settings or settings_for(recording)
    if poses is not None:
        settings = replace(settings, poses=poses)  # type: ignore[arg-type]
    return reconstruct_segments(recording, settings, on_station, folder, max_segments=1)[0]


def reconstruct_segments(
    recording: Recording,
    settings: ReconstructionSettings | None = None,
    on_station: Callable[[int], None] | None = None,
    folder: str | Path | None = None,
    max_segments: int | None = None,
) -> tuple[RowCloud, ...]:
    """Reconstruct all segments, or up to ``max_segments``, the one with the most stations first.

    Each segment has its own frame. The other arguments are those of `reconstruct_row`.
    """
    settings = settings or settings_for(recording)
    stations = register_stations(recording, settings, on_station, None if folder is None else Path(folder))
    numbers = range(len(stations.segments))[:max_segments]
    return tuple(remove_outliers(*merge_segment(stations, segment, settings)) for segment in numbers)


def merge_segment(
    registered: RegisteredStations, segment: int, settings: ReconstructionSettings
) -> tuple[RowCloud, npt.NDArray[np.bool_]]:
    """Merge one segment of the registered stations; return its cloud and the mask (n,) of outliers."""
    started = perf_counter()
    stations = registered.segments[segment]
    poses = np.full((len(registered.reports), 4, 4), np.nan)
    poses[list(stations)] = optimize_poses(stations, registered.edges, settings.fine_distance)
    is_registered = np.zeros(len(registered.reports), dtype=bool)
    is_registered[list(stations)] = True
    optimized = perf_counter()
    merged = merge_stations({i: registered.clouds[i] for i in stations}, poses, settings)
    rig = registered.calibration.rig
    outlier = find_outliers(merged, poses, registered.min_depths, rig, settings)
    cloud = merged.cloud
    warnings = _warnings(registered)
    if failure := exposure_failure(cloud.colors):
        warnings += (f"{failure}, so that shapes cannot be recognized by color",)
    seconds = registered.seconds | {"optimize": optimized - started, "merge": perf_counter() - optimized}
    report = RowReport(
        registered.reports,
        registered.segments,
        segment,
        warnings,
        registered.calibration_report,
        len(cloud),
        len(cloud),
        seconds,
    )
    observed = ObservedSpace(rig, {i: registered.min_depths[i] for i in stations})
    row = RowCloud(cloud.points, cloud.colors, cloud.normals, merged.station, is_registered, poses, report, observed)
    return row, outlier


def remove_outliers(row: RowCloud, outlier: npt.NDArray[np.bool_]) -> RowCloud:
    """Return the row without the points that a mask (n,) marks."""
    kept = ~outlier
    return replace(
        row,
        points=row.points[kept],
        colors=row.colors[kept],
        normals=row.normals[kept],
        station=row.station[kept],
        report=replace(row.report, points=int(np.count_nonzero(kept))),
    )


def _warnings(registered: RegisteredStations) -> tuple[str, ...]:
    """Return sentences on problems that a user should check."""
    warnings = []
    if len(registered.segments) > 1:
        parts = "; ".join(f"{s[0]} to {s[-1]} ({len(s)} stations)" for s in registered.segments)
        warnings.append(f"the row splits into {len(registered.segments)} segments: stations {parts}")
    skipped = sum(not report.registered for report in registered.reports)
    if skipped > 0.1 * len(registered.reports):
        warnings.append(f"{skipped} of {len(registered.reports)} stations were skipped")
    blind = [set(report.blind) for report in registered.reports if report.registered]
    always_blind = sorted(set.intersection(*blind)) if blind else []
    warnings += [f"camera {name!r} has no foreground at any station" for name in always_blind]
    return tuple(warnings)
