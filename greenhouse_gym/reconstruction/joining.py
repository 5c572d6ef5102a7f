"""Join the passes of a recording: stations at equal places along the row, registered to each other across the lift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from greenhouse_gym.capture.recordings import Pass, Recording
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, pose, rotation_angle, transform
from greenhouse_gym.reconstruction.graph import Edge
from greenhouse_gym.reconstruction.icp import align
from greenhouse_gym.reconstruction.registration import coarse_icp, unconvincing
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import Calibration, StationView, view_station

_EVERY = 3  # one in so many stations of a later pass is registered to the passes before
_BEGINNINGS = (0.0, 0.05, -0.05, 0.10, -0.10)  # m by which a pass may begin elsewhere than the first one
_ASTRAY = 0.10  # m a registration may lead away from where it started

Edges = Mapping[tuple[int, int], Edge]


def pass_of(passes: Sequence[Pass], station: int) -> int:
    """The number of the pass a station belongs to."""
    return sum(station >= one.first for one in passes) - 1


def join_segments(
    recording: Recording,
    calibration: Calibration,
    segments: Sequence[tuple[int, ...]],
    edges: Edges,
    settings: ReconstructionSettings,
) -> tuple[tuple[tuple[int, ...], ...], dict[tuple[int, int], Edge]]:
    """Register the longest segment of each later pass to those of the passes before.

    Args:
        recording: The recording, of two passes or more.
        calibration: Its cameras as they are.
        segments: Stations of each segment, the longest first; none spans two passes.
        edges: Accepted registrations within the passes.
        settings: All settings.

    Returns:
        The segments, the joined one first, and the edges between its passes.

    Raises:
        ReconstructionError: A pass has no segment long enough, or overlaps with none before it.
    """
    longest: list[tuple[int, ...]] = []
    for number in range(len(recording.passes)):
        own = [segment for segment in segments if pass_of(recording.passes, segment[0]) == number]
        if not own:
            raise ReconstructionError(
                f"recording {recording.name!r}: too few stations of pass {number} could be registered to each other"
            )
        longest.append(own[0])
    views: dict[int, StationView] = {}

    def view(station: int) -> StationView:
        if station not in views:
            views[station] = view_station(recording[station], calibration, settings)
        return views[station]

    along = {
        station: place
        for segment, one in zip(longest, recording.passes, strict=True)
        for station, place in _along(segment, one, edges, recording).items()
    }
    found: dict[tuple[int, int], Edge] = {}
    for number in range(1, len(longest)):
        before = [station for segment in longest[:number] for station in segment]
        beginnings: tuple[float, ...] = _BEGINNINGS
        reasons: list[str] = []
        for later in longest[number][::_EVERY]:
            earlier = min(before, key=lambda i: abs(along[i] - along[later]))
            lift = recording.passes[number].lift - recording.passes[pass_of(recording.passes, earlier)].lift
            for beginning in beginnings:
                apart = along[later] - along[earlier] + beginning
                start = pose(translation=[0.0, apart, lift])
                edge = register_near(view(earlier), view(later), start, settings)
                if isinstance(edge, Edge):
                    found[earlier, later] = edge
                    beginnings = (beginning,)
                    break
                reasons.append(f"station {later} to {earlier}: {edge}")
        if not any(later in longest[number] for _, later in found):
            raise ReconstructionError(
                f"recording {recording.name!r}: pass {number} overlaps with no pass before it. {'; '.join(reasons)}"
            )
    joined = tuple(station for segment in longest for station in segment)
    return (joined, *(segment for segment in segments if segment not in longest)), found


def _along(segment: Sequence[int], one: Pass, edges: Edges, recording: Recording) -> dict[int, float]:
    """How far along the row each station of a segment stands from where its pass began, metres."""
    head = recording.rig.cameras[recording.rig.reference].rig_from_camera[:3, 3]
    steps = [(transform(edges[pair].first_from_second, head[None])[0] - head)[1] for pair in pairwise(segment)]
    places = np.concatenate([[0.0], np.cumsum(steps)])
    pace = places[-1] / max(1, segment[-1] - segment[0])
    return dict(zip(segment, (places + pace * (segment[0] - one.first)).tolist(), strict=True))


def register_near(
    first: StationView, second: StationView, start: Array, settings: ReconstructionSettings
) -> Edge | str:
    """The registration of two stations that stand ``start`` (4, 4) apart to a few centimetres, or why there is none."""
    near = start
    for distance in (3 * settings.coarse_distance, settings.coarse_distance):
        near = coarse_icp(first, second, near, distance, settings)
    found = align(first, second.sample, near, settings)
    moved = np.round(found.first_from_second, 9)
    head = second.reference.camera.rig_from_camera[None, :3, 3]
    astray = float(np.linalg.norm(transform(moved, head) - transform(start, head)))
    reason = unconvincing(found, settings)
    if not reason and (astray > _ASTRAY or rotation_angle(moved[:3, :3]) > settings.max_rotation):
        reason = f"led {100 * astray:.0f} cm astray"
    return reason or Edge(moved, found.information)
