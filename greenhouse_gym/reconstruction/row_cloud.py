"""Reconstruction of a recording as one cloud of the row: register, optimize, merge, remove outliers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud, exposure_failure
from greenhouse_gym.reconstruction.fitting import settings_for
from greenhouse_gym.reconstruction.merging import find_outliers, merge_stations
from greenhouse_gym.reconstruction.pose_graph import optimize_poses
from greenhouse_gym.reconstruction.report import RowReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_registration import RegisteredStations, register_stations
from greenhouse_gym.reconstruction.station_views import MinDepth


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
