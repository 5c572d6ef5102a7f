"""Walk through a recording: register each station to the ones before it, then optimize all poses together."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction.calibration import estimate_bias
from greenhouse_gym.reconstruction.clouds import Cloud
from greenhouse_gym.reconstruction.registration import Registration, StationView, refine, register, view_station
from greenhouse_gym.reconstruction.settings import ReconstructionSettings

Edges = dict[tuple[int, int], Registration]
"""Accepted registrations by the numbers of the earlier and the later station."""


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
    """How a reconstruction went.

    Attributes:
        stations: What happened to each station.
        bias: Relative depth error of each camera as estimated, by name.
        merged_points: Points before outlier removal.
        points: Points after it.
        seconds: Time of each stage.
    """

    stations: tuple[StationReport, ...]
    bias: dict[str, float] = field(default_factory=dict)
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


def register_stations(
    recording: Recording,
    settings: ReconstructionSettings,
    on_station: Callable[[int], None] | None = None,
) -> RegisteredStations:
    """Read and register the stations one after the other, skipping those that cannot be registered.

    Raises:
        ReconstructionError: Fewer than two stations could be registered.
    """
    started = perf_counter()
    bias = estimate_bias(recording, settings)
    calibrating = perf_counter() - started
    reports: list[StationReport] = []
    good: list[int] = []
    views: dict[int, StationView] = {}
    clouds: list[Cloud | None] = [None] * len(recording)
    edges: Edges = {}
    reading = registering = 0.0
    for i in range(len(recording)):
        started = perf_counter()
        view = view_station(recording[i], recording.rig, settings, bias)
        read = perf_counter()
        report, own_edges = _try_station(i, view, good, views, edges, recording.rig, settings)
        reports.append(report)
        if report.registered:
            edges |= own_edges
            good.append(i)
            views[i] = view
            clouds[i] = view.cloud
            for old in good[: -max(settings.links, default=1)]:
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
    seconds = {
        "calibrate": calibrating, "read": reading, "register": registering, "optimize": perf_counter() - started,
    }  # fmt: skip
    report_of_all = RowReport(tuple(reports), bias, seconds=seconds)
    return RegisteredStations(tuple(clouds), poses, registered, report_of_all)


def _try_station(
    i: int,
    view: StationView,
    good: list[int],
    views: dict[int, StationView],
    edges: Edges,
    rig: Rig,
    settings: ReconstructionSettings,
) -> tuple[StationReport, Edges]:
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
    start = found.first_from_second  # the pose in the frame of ever earlier stations
    for count in range(2, max(settings.links, default=1) + 1):
        if not found.accepted or count > len(good):
            break
        earlier = good[-count]
        start = edges[earlier, good[-count + 1]].first_from_second @ start
        if count in settings.links:
            further = refine(views[earlier], view, start, rig, i - earlier, settings)
            if further.accepted:
                own[earlier, i] = further
    return report, own


def _optimize(good: list[int], edges: Edges, settings: ReconstructionSettings) -> Array:
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
