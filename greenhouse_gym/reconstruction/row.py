"""From a recording to one cloud of the row: register, optimize, merge, remove outliers."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction.clouds import Cloud, merge, to_open3d, voxel_means
from greenhouse_gym.reconstruction.registration import Registration, StationView, refine, register, view_station
from greenhouse_gym.reconstruction.settings import ReconstructionSettings


@dataclass(frozen=True)
class StationReport:
    """What happened to one station.

    Attributes:
        station: Its number.
        registered: Whether it is part of the row.
        against: The station it was registered to; None for the first.
        reason: Why it was skipped, or "".
        shift_pixels: Best shift of the silhouettes.
        fitness: Share of points with a partner after ICP.
        rmse: Of those partners, metres.
    """

    station: int
    registered: bool
    against: int | None = None
    reason: str = ""
    shift_pixels: int | None = None
    fitness: float | None = None
    rmse: float | None = None


@dataclass(frozen=True)
class RowReport:
    """How a reconstruction went: one entry per station, points before and after, seconds per stage."""

    stations: tuple[StationReport, ...]
    merged_points: int = 0
    points: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RegisteredStations:
    """Stations in one frame, not yet merged.

    Attributes:
        clouds: Each station's foreground in its rig frame; None where not registered.
        world_from_station: (stations, 4, 4); NaN where not registered, identity for the first that is.
        registered: (stations,) bool.
        report: What happened to each station.
    """

    clouds: tuple[Cloud | None, ...]
    world_from_station: Array
    registered: npt.NDArray[np.bool_]
    report: RowReport


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


def register_stations(
    recording: Recording,
    settings: ReconstructionSettings,
    on_station: Callable[[int], None] | None = None,
) -> RegisteredStations:
    """Read and register the stations one after the other, skipping those that cannot be registered.

    Raises:
        ReconstructionError: Fewer than two stations could be registered.
    """
    reports: list[StationReport] = []
    good: list[int] = []
    views: dict[int, StationView] = {}
    clouds: list[Cloud | None] = [None] * len(recording)
    edges: dict[tuple[int, int], Registration] = {}
    reading = registering = 0.0
    for i in range(len(recording)):
        started = perf_counter()
        view = view_station(recording[i], recording.rig, settings)
        read = perf_counter()
        report, own_edges = _try_station(i, view, good, views, edges, recording.rig, settings)
        reports.append(report)
        if report.registered:
            edges |= own_edges
            good.append(i)
            views[i] = view
            clouds[i] = view.cloud
            for old in good[: -settings.neighbours]:
                views.pop(old, None)  # memory grows with the clouds, not with the images
        reading += read - started
        registering += perf_counter() - read
        if on_station:
            on_station(i)
    if len(good) < max(1, min(2, len(recording))):
        reasons = "; ".join(f"station {r.station}: {r.reason}" for r in reports if r.reason)
        raise ReconstructionError(
            f"recording {recording.name!r}: {len(good)} of {len(recording)} stations registered, at least 2 needed. "
            f"{reasons}"
        )
    started = perf_counter()
    poses = np.full((len(recording), 4, 4), np.nan)
    poses[good] = _optimize(good, edges, settings)
    registered = np.zeros(len(recording), dtype=bool)
    registered[good] = True
    seconds = {"read": reading, "register": registering, "optimize": perf_counter() - started}
    return RegisteredStations(tuple(clouds), poses, registered, RowReport(tuple(reports), seconds=seconds))


def _try_station(
    i: int,
    view: StationView,
    good: list[int],
    views: dict[int, StationView],
    edges: dict[tuple[int, int], Registration],
    rig: Rig,
    settings: ReconstructionSettings,
) -> tuple[StationReport, dict[tuple[int, int], Registration]]:
    """Register station ``i`` to the last good one, and to the ones before it for the pose graph."""
    if not good:
        mask = view.frame is not None and bool((view.frame.depth > 0).any()) and len(view.cloud) > 0
        reason = "" if mask else "no foreground"
        return StationReport(i, bool(mask), reason=reason), {}
    last = good[-1]
    found = register(views[last], view, rig, i - last, settings)
    report = StationReport(
        i, found.accepted, last, found.reason, found.shift.pixels if found.shift else None, found.fitness, found.rmse
    )
    own = {(last, i): found} if found.accepted else {}
    back = found.first_from_second
    for earlier, later in zip(reversed(good[-settings.neighbours : -1]), reversed(good), strict=False):
        if not found.accepted:
            break
        back = edges[earlier, later].first_from_second @ back
        further = refine(views[earlier], view, back, rig, i - earlier, settings)
        if further.accepted:
            own[earlier, i] = further
    return report, own


def _optimize(good: list[int], edges: dict[tuple[int, int], Registration], settings: ReconstructionSettings) -> Array:
    """Poses (k, 4, 4) of the good stations in the first one's frame, by pose-graph optimization over all edges."""
    pipelines = open3d().pipelines.registration
    graph = pipelines.PoseGraph()
    number = {station: k for k, station in enumerate(good)}
    poses = [np.eye(4)]
    for earlier, later in itertools.pairwise(good):
        poses.append(poses[-1] @ edges[earlier, later].first_from_second)
    for world_from_station in poses:
        graph.nodes.append(pipelines.PoseGraphNode(world_from_station))
    for (earlier, later), edge in edges.items():
        graph.edges.append(
            pipelines.PoseGraphEdge(
                number[later], number[earlier], edge.first_from_second, edge.information, uncertain=False
            )
        )
    if len(edges) >= len(good):
        pipelines.global_optimization(
            graph,
            pipelines.GlobalOptimizationLevenbergMarquardt(),
            pipelines.GlobalOptimizationConvergenceCriteria(),
            pipelines.GlobalOptimizationOption(max_correspondence_distance=settings.fine_distance, reference_node=0),
        )
    optimized = np.array([node.pose for node in graph.nodes])
    return np.round(invert(optimized[0]) @ optimized, 9)


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
