"""From a recording to one cloud of the row: walk, optimize, merge, remove outliers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.fitting import settings_for
from greenhouse_gym.reconstruction.graph import optimize
from greenhouse_gym.reconstruction.merging import merge_stations, outliers
from greenhouse_gym.reconstruction.point_clouds import Cloud, exposure_failure
from greenhouse_gym.reconstruction.report import RowReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import Screen
from greenhouse_gym.reconstruction.walk import Walk, walk_through


class Look(NamedTuple):
    """What another rig saw from one place: its pose (4, 4) in the row's frame, its cameras, and a screen of each."""

    row_from_rig: Array
    rig: Rig
    screens: Mapping[str, Screen]


@dataclass(frozen=True, eq=False)
class Sight:
    """What the stations saw of space.

    Attributes:
        rig: The cameras as they are.
        screens: For each station and camera, the nearest reading of each block of pixels.
        looks: What was seen besides; see `greenhouse_gym.reconstruction.add_looks`.
    """

    rig: Rig
    screens: Mapping[int, Mapping[str, Screen]]
    looks: tuple[Look, ...] = ()


@dataclass(frozen=True, eq=False)
class RowCloud(Cloud):
    """A row as one cloud, in the frame of its first registered station (metres; z up, y along the row).

    Attributes:
        station: (n,) number of the station a point was first seen from.
        registered: (stations,) bool.
        world_from_station: (stations, 4, 4); NaN where not registered, identity for the first that is.
        report: What happened on the way.
        sight: What the stations saw of space; None for a cloud that was read from a file.
    """

    station: npt.NDArray[np.int32]
    registered: npt.NDArray[np.bool_]
    world_from_station: Array
    report: RowReport
    sight: Sight | None = None


def reconstruct_row(
    recording: Recording,
    settings: ReconstructionSettings | None = None,
    on_station: Callable[[int], None] | None = None,
    folder: str | Path | None = None,
    poses: str | None = None,
) -> RowCloud:
    """Turn a recording into one metric cloud of the row, as the paper does, and some steps beyond.

    60 cm foreground, silhouettes shifted to the least difference, mean XYZ offset, ICP; a station that cannot be
    registered is skipped and the next tried against the last good one; merge of all cameras; removal of what few
    stations saw. Beyond the paper, the cameras are calibrated from what they see in common, stations two and three
    steps apart are registered as well, and the pose graph is optimized.

    Where the row falls apart into segments that cannot be registered to each other, this is the one with the most
    stations, and the report names the others; `reconstruct_segments` gives all.

    Args:
        recording: The recording; its stations are read one at a time.
        settings: All settings; by default what the recording's protocol needs, the paper's values where it names none.
        on_station: Called with the number of each station when it is done (for progress bars).
        folder: Where to note what was registered, so that an interrupted reconstruction goes on from there.
        poses: "estimate" finds where the stations stood; "given" believes the recording, for rigs on rails and cameras
            on arms; "refine" corrects what it says by what was seen. By default what the settings say.

    Raises:
        UnknownNameError: There is no such way to pose the stations.
        ReconstructionError: Too few stations could be registered; the message gives the reasons.
    """
    settings = settings or settings_for(recording)
    if poses is not None:
        settings = replace(settings, poses=poses)  # type: ignore[arg-type]
    return reconstruct_segments(recording, settings, on_station, folder, most=1)[0]


def reconstruct_segments(
    recording: Recording,
    settings: ReconstructionSettings | None = None,
    on_station: Callable[[int], None] | None = None,
    folder: str | Path | None = None,
    most: int | None = None,
) -> tuple[RowCloud, ...]:
    """Like `reconstruct_row`, all segments, the one with the most stations first, each in a frame of its own.

    Args:
        recording: The recording.
        settings: All settings.
        on_station: Called with the number of each station when it is done.
        folder: Where to note what was registered.
        most: Segments wanted; None for all.
    """
    settings = settings or settings_for(recording)
    walk = walk_through(recording, settings, on_station, None if folder is None else Path(folder))
    return tuple(
        remove_outliers(*merge_segment(walk, segment, settings)) for segment in range(len(walk.segments))[:most]
    )


def merge_segment(walk: Walk, segment: int, settings: ReconstructionSettings) -> tuple[RowCloud, npt.NDArray[np.bool_]]:
    """One segment of a walk as one cloud, and which of its points (n,) are outliers."""
    started = perf_counter()
    stations = walk.segments[segment]
    poses = np.full((len(walk.reports), 4, 4), np.nan)
    poses[list(stations)] = optimize(stations, walk.edges, settings.fine_distance)
    registered = np.zeros(len(walk.reports), dtype=bool)
    registered[list(stations)] = True
    optimized = perf_counter()
    merged = merge_stations({i: walk.clouds[i] for i in stations}, poses, settings)
    outlier = outliers(merged, poses, walk.screens, walk.calibration.rig, settings)
    cloud = merged.cloud
    warnings = _warnings(walk)
    if failure := exposure_failure(cloud.colors):
        warnings += (f"{failure}, so that no shapes can be told by color",)
    report = RowReport(
        walk.reports, walk.segments, segment, warnings, walk.calibrated, len(cloud), len(cloud),
        walk.seconds | {"optimize": optimized - started, "merge": perf_counter() - optimized},
    )  # fmt: skip
    sight = Sight(walk.calibration.rig, {i: walk.screens[i] for i in stations})
    row = RowCloud(cloud.points, cloud.colors, cloud.normals, merged.station, registered, poses, report, sight)
    return row, outlier


def remove_outliers(row: RowCloud, outlier: npt.NDArray[np.bool_]) -> RowCloud:
    """The row without the points marked (n,)."""
    kept = ~outlier
    return RowCloud(
        row.points[kept], row.colors[kept], row.normals[kept], row.station[kept],
        row.registered, row.world_from_station, replace(row.report, points=int(np.count_nonzero(kept))), row.sight,
    )  # fmt: skip


def _warnings(walk: Walk) -> tuple[str, ...]:
    """What a user should look at."""
    warnings = []
    if len(walk.segments) > 1:
        parts = "; ".join(f"{s[0]} to {s[-1]} ({len(s)} stations)" for s in walk.segments)
        warnings.append(f"the row falls apart into {len(walk.segments)} segments: stations {parts}")
    skipped = sum(not report.registered for report in walk.reports)
    if skipped > 0.1 * len(walk.reports):
        warnings.append(f"{skipped} of {len(walk.reports)} stations were skipped")
    seeing = [set(report.blind) for report in walk.reports if report.registered]
    blind = sorted(set.intersection(*seeing)) if seeing else []
    warnings += [f"camera {name!r} saw no foreground at any station" for name in blind]
    return tuple(warnings)
