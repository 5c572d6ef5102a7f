"""Station registration: register each station to the ones before it, and skip those that cannot be registered.

A station that fits no segment of the row begins a new one: a gap too wide to be bridged splits the row, and a station
out of place remains alone and is skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from time import perf_counter

import numpy as np

from greenhouse_gym.capture.recordings import Pass, Recording
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError, ReconstructionError
from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.geometry.point_clouds import PackedCloud
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.foreground import foreground_problem
from greenhouse_gym.reconstruction.pair_registration import LONGEST_GAP, Registration, refine_pair, register_pair
from greenhouse_gym.reconstruction.pass_registration import pass_index, register_given_pose, register_passes
from greenhouse_gym.reconstruction.pose_graph import PoseEdge, PoseEdges
from greenhouse_gym.reconstruction.report import CalibrationReport, StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_journal import JournalEntry, StationJournal
from greenhouse_gym.reconstruction.station_views import Calibration, MinDepth, StationView, station_view

with needs("reconstruct"):
    from threadpoolctl import threadpool_limits

_SEGMENTS_TRIED = 3  # that a station is registered to, the longest first
_MIN_SEGMENT = 3  # stations of a segment other than the longest one
_MIN_REGISTERED = 0.25  # fraction of the stations

Segments = dict[int, list[int]]
"""Stations of each segment, by the number of its first."""


@dataclass(frozen=True, eq=False)
class RegisteredStations:
    """Result of station registration."""

    calibration: Calibration  # the calibrated cameras
    calibration_report: CalibrationReport  # figures of the calibration
    reports: tuple[StationReport, ...]  # report of each station
    segments: tuple[tuple[int, ...], ...]  # numbers of the stations of each segment, the longest first
    edges: PoseEdges  # accepted registrations by the numbers of the earlier and the later station
    clouds: Mapping[int, PackedCloud]  # each station's foreground in its rig frame, by its number
    min_depths: Mapping[int, Mapping[str, MinDepth]]  # nearest readings of each station's cameras
    seconds: dict[str, float]  # time of each stage


def register_stations(
    recording: Recording,
    settings: ReconstructionSettings,
    on_station: Callable[[int], None] | None = None,
    folder: Path | None = None,
) -> RegisteredStations:
    """Read and register the stations one after the other.

    Args:
        recording: Its stations are read one at a time, the next while one is registered.
        settings: All settings.
        on_station: Called with the number of each station when it is done.
        folder: Folder of the journal from which an interrupted registration resumes.

    Raises:
        ReconstructionError: Too few stations could be registered; the message gives the reasons.
    """
    started = perf_counter()
    estimated = settings.poses == "estimate"
    calibration, calibration_report = calibrate(recording, settings)
    calibrated = perf_counter()
    journal = StationJournal.open(folder, recording, settings)
    segments: Segments = {}
    edges: dict[tuple[int, int], PoseEdge] = {}
    views: dict[int, StationView] = {}

    def add(entry: JournalEntry) -> None:
        i, first = entry.report.station, entry.report.segment
        if first is not None:
            segments.setdefault(first, []).append(i)
        edges.update({(earlier, i): edge for earlier, edge in entry.edges.items()})
        if on_station:
            on_station(i)

    for entry in journal.entries:
        add(entry)
    with threadpool_limits(1, "blas"):  # two threads here are faster than BLAS's on small products
        for i, view in _prepared_views(recording, calibration, settings, len(journal.entries)):
            if isinstance(view, str):
                entry = JournalEntry(StationReport(i, False, reason=view))
            else:
                near = _near_segments(segments, i, recording.passes, settings) if estimated else [*segments.values()]
                kept = [station for segment in near for station in segment[-max(settings.links, default=1) :]]
                views = {  # memory grows with the clouds, not with the images; read again after an interruption
                    k: views[k] if k in views else station_view(recording[k], calibration, settings) for k in kept
                }
                if estimated:
                    report, links = _register_station(i, view, near, views, edges, settings)
                else:
                    report, links = register_given_pose(i, view, near[0] if near else (), views, settings)
                entry = JournalEntry(report, links, view.packed_cloud(), view.min_depths())
                views[i] = view
            journal.write(entry)
            add(entry)
    kept_segments = _kept_segments(journal.entries, segments, recording.name)
    if estimated and len(recording.passes) > 1:
        kept_segments, between = register_passes(recording, calibration, kept_segments, edges, settings)
        edges.update(between)
    number = {station: k for k, segment in enumerate(kept_segments) for station in segment}
    reports = tuple(
        replace(report, registered=report.station in number, segment=number.get(report.station))
        for report in (entry.report for entry in journal.entries)
    )
    return RegisteredStations(
        calibration,
        calibration_report,
        reports,
        kept_segments,
        edges,
        {entry.report.station: entry.cloud for entry in journal.entries if entry.cloud is not None},
        {entry.report.station: entry.min_depths for entry in journal.entries},
        {"calibrate": calibrated - started, "register": perf_counter() - calibrated},
    )


def _prepared_views(
    recording: Recording, calibration: Calibration, settings: ReconstructionSettings, first: int
) -> Iterator[tuple[int, StationView | str]]:
    """Yield each station from ``first`` on, or why it cannot be used; the next one is prepared meanwhile."""

    def prepared(i: int) -> StationView | str:
        try:
            view = station_view(recording[i], calibration, settings)
        except FileFormatError as error:
            return str(error)
        problem = foreground_problem(view.reference.depth, view.reference.foreground, settings.foreground)
        return f"camera {calibration.rig.reference!r}: {problem}" if problem else view

    with ThreadPoolExecutor(1) as background:
        upcoming = background.submit(prepared, first) if first < len(recording) else None
        for i in range(first, len(recording)):
            assert upcoming is not None
            view = upcoming.result()
            if i + 1 < len(recording):
                upcoming = background.submit(prepared, i + 1)
            yield i, view


def _near_segments(
    segments: Segments, i: int, passes: Sequence[Pass], settings: ReconstructionSettings
) -> list[list[int]]:
    """Return the segments of its pass whose end may lie within reach of station ``i``, the longest first."""
    own = [s for s in segments.values() if pass_index(passes, s[0]) == pass_index(passes, i)]
    within_reach = [s for s in own if (i - s[-1]) * settings.step_range[0] <= LONGEST_GAP]
    return sorted(within_reach, key=lambda s: (-len(s), -s[-1]))[:_SEGMENTS_TRIED]


def _register_station(
    i: int,
    view: StationView,
    near: list[list[int]],
    views: Mapping[int, StationView],
    edges: PoseEdges,
    settings: ReconstructionSettings,
) -> tuple[StationReport, dict[int, PoseEdge]]:
    """Register station ``i`` to the last station of a segment and to those before; else it begins its own segment."""
    refused = StationReport(i, True, segment=i, blind=view.blind)
    for segment in near:
        last = segment[-1]
        stride = _stride(segment, edges, view)
        found = register_pair(views[last], view, i - last, settings, stride)
        pixels = found.shift.pixels if found.shift else None
        first = segment[0] if found.accepted else i
        report = StationReport(
            i, found.accepted, last, found.reason, pixels, found.fitness, found.rmse, first, view.blind
        )
        if found.accepted:
            return report, _links(i, view, found, segment, views, edges, stride, settings)
        if refused.against is None:
            refused = report
    return refused, {}


def _stride(segment: list[int], edges: PoseEdges, view: StationView) -> float:
    """Return the metres along the rig's y per station at the end of a segment; 0 if it has a single station."""
    if len(segment) < 2:
        return 0.0
    head = view.reference.camera.rig_from_camera[:3, 3]
    end = segment[-6:]
    moved = sum((transform(edges[pair].first_from_second, head[None])[0] - head)[1] for pair in pairwise(end))
    return float(moved / (end[-1] - end[0]))


def _links(
    i: int,
    view: StationView,
    found: Registration,
    segment: list[int],
    views: Mapping[int, StationView],
    edges: PoseEdges,
    stride: float,
    settings: ReconstructionSettings,
) -> dict[int, PoseEdge]:
    """Return the registration to the last station of a segment, and those to the ones before it that are accepted."""
    starts: dict[int, Array] = {}
    start = found.first_from_second  # the pose in the frame of ever earlier stations
    for count in range(2, min(max(settings.links, default=1), len(segment)) + 1):
        earlier = segment[-count]
        start = edges[earlier, segment[-count + 1]].first_from_second @ start
        if count in settings.links:
            starts[earlier] = start
    with ThreadPoolExecutor(max(1, len(starts))) as pool:
        further = pool.map(lambda k: refine_pair(views[k], view, starts[k], i - k, stride, settings), starts)
        links = {segment[-1]: found} | {k: link for k, link in zip(starts, further, strict=True) if link.accepted}
    return {
        earlier: PoseEdge(link.first_from_second, link.information)
        for earlier, link in links.items()
        if link.information is not None
    }


def _kept_segments(entries: list[JournalEntry], segments: Segments, name: str) -> tuple[tuple[int, ...], ...]:
    """Return the segments of enough stations, the longest first; `ReconstructionError` if too few belong to any."""
    ordered = sorted(segments.values(), key=lambda s: (-len(s), s[0]))
    kept = [s for k, s in enumerate(ordered) if len(s) >= (_MIN_SEGMENT if k else 2)]
    registered = sum(map(len, kept))
    needed = max(2, int(np.ceil(_MIN_REGISTERED * len(entries))))
    if registered < needed and not len(entries) == len(segments) == 1:
        reasons = "; ".join(f"station {e.report.station}: {e.report.reason}" for e in entries if e.report.reason)
        raise ReconstructionError(
            f"recording {name!r}: {registered} of {len(entries)} stations registered, at least {needed} needed. "
            f"{reasons}"
        )
    return tuple(tuple(segment) for segment in kept or ordered)
