"""Walk through a recording: register each station to the ones before it, skip what cannot be registered.

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
from greenhouse_gym.reconstruction.calibration import CalibrationReport, calibrate
from greenhouse_gym.reconstruction.diary import Diary, Entry
from greenhouse_gym.reconstruction.foreground import foreground_problem
from greenhouse_gym.reconstruction.given import place_as_given
from greenhouse_gym.reconstruction.graph import Edge
from greenhouse_gym.reconstruction.joining import join_segments, pass_of
from greenhouse_gym.reconstruction.point_clouds import PackedCloud
from greenhouse_gym.reconstruction.registration import Registration, refine, register
from greenhouse_gym.reconstruction.report import StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import Calibration, Screen, StationView, view_station

with needs("reconstruct"):
    from threadpoolctl import threadpool_limits

_TRIED = 3  # segments a station is tried against, the longest first
_SHORTEST = 3  # stations that make a segment beside the longest one

Segments = dict[int, list[int]]
"""Stations of each segment, by the number of its first."""


@dataclass(frozen=True, eq=False)
class Walk:
    """All stations of a recording after the walk.

    Attributes:
        calibration: The cameras as they are.
        calibrated: What was found out about them.
        reports: What happened to each station.
        segments: Numbers of the stations of each segment, the longest first.
        edges: Accepted registrations by the numbers of the earlier and the later station.
        clouds: Each station's foreground in its rig frame, by its number.
        screens: What each station's cameras did not see through.
        seconds: Time of each stage.
    """

    calibration: Calibration
    calibrated: CalibrationReport
    reports: tuple[StationReport, ...]
    segments: tuple[tuple[int, ...], ...]
    edges: Mapping[tuple[int, int], Edge]
    clouds: Mapping[int, PackedCloud]
    screens: Mapping[int, Mapping[str, Screen]]
    seconds: dict[str, float]


def walk_through(
    recording: Recording,
    settings: ReconstructionSettings,
    on_station: Callable[[int], None] | None = None,
    folder: Path | None = None,
) -> Walk:
    """Read and register the stations one after the other.

    Args:
        recording: Its stations are read one at a time, the next while one is registered.
        settings: All settings.
        on_station: Called with the number of each station when it is done.
        folder: Where to note what was registered, so that an interrupted walk goes on from there.

    Raises:
        ReconstructionError: Too few stations could be registered; the message gives the reasons.
    """
    started = perf_counter()
    estimated = settings.poses == "estimate"
    calibration, calibrated = calibrate(recording, settings)
    calibrated_at = perf_counter()
    diary = Diary.open(folder, recording, settings)
    segments: Segments = {}
    edges: dict[tuple[int, int], Edge] = {}
    views: dict[int, StationView] = {}

    def note(entry: Entry) -> None:
        i, first = entry.report.station, entry.report.segment
        if first is not None:
            segments.setdefault(first, []).append(i)
        edges.update({(earlier, i): edge for earlier, edge in entry.edges.items()})
        if on_station:
            on_station(i)

    for entry in diary.entries:
        note(entry)
    with threadpool_limits(1, "blas"):  # two threads of our own do better than BLAS's on small products
        for i, view in _views(recording, calibration, settings, len(diary.entries)):
            if isinstance(view, str):
                entry = Entry(StationReport(i, False, reason=view))
            else:
                near = _near(segments, i, recording.passes, settings) if estimated else [*segments.values()]
                kept = [station for segment in near for station in segment[-max(settings.links, default=1) :]]
                views = {  # memory grows with the clouds, not with the images; read again after an interruption
                    k: views[k] if k in views else view_station(recording[k], calibration, settings) for k in kept
                }
                if estimated:
                    entry = _place(i, view, near, views, edges, settings)
                else:
                    report, given = place_as_given(i, view, near[0] if near else (), views, settings)
                    entry = Entry(report, given, view.cloud(), _screens(view))
                views[i] = view
            diary.write(entry)
            note(entry)
    kept_segments = _conclude(diary.entries, segments, recording.name, settings)
    if estimated and len(recording.passes) > 1:
        kept_segments, between = join_segments(recording, calibration, kept_segments, edges, settings)
        edges.update(between)
    number = {station: k for k, segment in enumerate(kept_segments) for station in segment}
    reports = tuple(
        replace(report, registered=report.station in number, segment=number.get(report.station))
        for report in (entry.report for entry in diary.entries)
    )
    return Walk(
        calibration,
        calibrated,
        reports,
        kept_segments,
        edges,
        {entry.report.station: entry.cloud for entry in diary.entries if entry.cloud is not None},
        {entry.report.station: entry.screens for entry in diary.entries},
        {"calibrate": calibrated_at - started, "register": perf_counter() - calibrated_at},
    )


def _views(
    recording: Recording, calibration: Calibration, settings: ReconstructionSettings, first: int
) -> Iterator[tuple[int, StationView | str]]:
    """Each station from ``first`` on, or why it cannot be used; the next one is prepared meanwhile."""

    def prepare(i: int) -> StationView | str:
        try:
            view = view_station(recording[i], calibration, settings)
        except FileFormatError as error:
            return str(error)
        problem = foreground_problem(
            view.reference.depth, view.reference.foreground,
            settings.foreground, settings.min_foreground, settings.max_foreground,
        )  # fmt: skip
        return f"camera {calibration.rig.reference!r}: {problem}" if problem else view

    with ThreadPoolExecutor(1) as background:
        upcoming = background.submit(prepare, first) if first < len(recording) else None
        for i in range(first, len(recording)):
            assert upcoming is not None
            view = upcoming.result()
            if i + 1 < len(recording):
                upcoming = background.submit(prepare, i + 1)
            yield i, view


def _near(segments: Segments, i: int, passes: Sequence[Pass], settings: ReconstructionSettings) -> list[list[int]]:
    """The segments station ``i`` may belong to, the longest first: those whose end may lie within the longest gap."""
    own = [s for s in segments.values() if pass_of(passes, s[0]) == pass_of(passes, i)]
    open_ones = [s for s in own if (i - s[-1]) * settings.step_range[0] <= settings.longest_gap]
    return sorted(open_ones, key=lambda s: (-len(s), -s[-1]))[:_TRIED]


def _place(
    i: int,
    view: StationView,
    near: list[list[int]],
    views: Mapping[int, StationView],
    edges: Mapping[tuple[int, int], Edge],
    settings: ReconstructionSettings,
) -> Entry:
    """Register station ``i`` to the last station of a segment and to those before; else it begins its own segment."""
    cloud = view.cloud()
    screens = _screens(view)
    blind = tuple(name for name, camera in view.cameras.items() if not camera.foreground.any())
    refused = StationReport(i, True, segment=i, blind=blind)
    for segment in near:
        last = segment[-1]
        pace = _pace(segment, edges, view)
        found = register(views[last], view, i - last, settings, pace)
        report = StationReport(
            i, found.accepted, last, found.reason, found.shift.pixels if found.shift else None,
            found.fitness, found.rmse, segment[0] if found.accepted else i, blind,
        )  # fmt: skip
        if found.accepted:
            return Entry(report, _links(i, view, found, segment, views, edges, pace, settings), cloud, screens)
        if refused.against is None:
            refused = report
    return Entry(refused, {}, cloud, screens)


def _screens(view: StationView) -> dict[str, Screen]:
    return {name: camera.screen() for name, camera in view.cameras.items()}


def _pace(segment: list[int], edges: Mapping[tuple[int, int], Edge], view: StationView) -> float:
    """Metres along the rig's y from a station to the next, over the end of a segment; 0 if it has a single station."""
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
    edges: Mapping[tuple[int, int], Edge],
    pace: float,
    settings: ReconstructionSettings,
) -> dict[int, Edge]:
    """The registration to the last station of a segment, and those to the ones before it that are accepted."""
    starts: dict[int, Array] = {}
    start = found.first_from_second  # the pose in the frame of ever earlier stations
    for count in range(2, min(max(settings.links, default=1), len(segment)) + 1):
        earlier = segment[-count]
        start = edges[earlier, segment[-count + 1]].first_from_second @ start
        if count in settings.links:
            starts[earlier] = start
    with ThreadPoolExecutor(max(1, len(starts))) as pool:
        further = pool.map(lambda k: refine(views[k], view, starts[k], i - k, pace, settings), starts)
        links = {segment[-1]: found} | {k: link for k, link in zip(starts, further, strict=True) if link.accepted}
    return {
        earlier: Edge(link.first_from_second, link.information)
        for earlier, link in links.items()
        if link.information is not None
    }


def _conclude(
    entries: list[Entry], segments: Segments, name: str, settings: ReconstructionSettings
) -> tuple[tuple[int, ...], ...]:
    """The segments worth the name, the longest first.

    Raises:
        ReconstructionError: Too few stations belong to any.
    """
    ordered = sorted(segments.values(), key=lambda s: (-len(s), s[0]))
    kept = [s for k, s in enumerate(ordered) if len(s) >= (_SHORTEST if k else 2)]
    registered = sum(map(len, kept))
    least = max(2, int(np.ceil(settings.min_registered * len(entries))))
    if registered < least and not len(entries) == len(segments) == 1:
        reasons = "; ".join(f"station {e.report.station}: {e.report.reason}" for e in entries if e.report.reason)
        raise ReconstructionError(
            f"recording {name!r}: {registered} of {len(entries)} stations registered, at least {least} needed. "
            f"{reasons}"
        )
    return tuple(tuple(segment) for segment in kept or ordered)
